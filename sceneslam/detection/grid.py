"""Evaluation of thousands of detector and policy settings on features computed once."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import product
from typing import Any

from sceneslam.bus.policy import Policy
from sceneslam.config.component import ComponentBuilder
from sceneslam.detection.decide import confirm, vote
from sceneslam.detection.run import Watched, score, watch
from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.interfaces import FeatureDetector
from sceneslam.types.errors import SceneSlamError
from sceneslam.types.observation import SceneVote

Setting = Mapping[str, Any]  # full key -> value


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """A key of detector or policy and its tried values."""

    key: str
    values: Sequence[Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tried:
    """The metrics of a setting, or why it could not be tried."""

    setting: Setting
    metrics: Metrics = field(default_factory=dict)
    error: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ballot:
    """The votes of a detector's setting on a recording."""

    watched: Watched
    votes: Sequence[SceneVote]
    scenes: Sequence[str]


def try_all(config: Mapping[str, Any], axes: Sequence[Axis]) -> Iterator[Tried]:
    """Yield the results of all combinations of the axes' values, the last axis fastest.

    The recording is read once per detector with different features, and votes are computed once per
    detector's setting.
    """
    detectors = list(_settings(axes, "detector."))
    policies = [_built(config, setting) for setting in _settings(axes, "policy.")]
    evaluation = ComponentBuilder(config).make("evaluation", EvaluationSettings)
    watched: dict[str, Watched] = {}
    for setting in detectors:
        try:
            ballot = _votes(_with(config, setting), watched)
        except SceneSlamError as error:
            yield from (
                Tried(setting={**setting, **other}, error=str(error)) for other, _ in policies
            )
            continue
        for other, policy in policies:
            both = {**setting, **other}
            if isinstance(policy, SceneSlamError):
                yield Tried(setting=both, error=str(policy))
            else:
                confirmed = confirm(ballot.votes, policy, ballot.scenes)
                yield Tried(
                    setting=both, metrics=score(ballot.watched.features, confirmed, evaluation)
                )


def _votes(config: Mapping[str, Any], watched: dict[str, Watched]) -> _Ballot:
    detector = ComponentBuilder(config).make("detector", FeatureDetector)
    kind = json.dumps([config["detector"].get(name) for name in detector.feature_settings])
    if kind not in watched:
        watched[kind] = watch(config)
    seen = watched[kind]
    votes = vote(detector, seen.rig, seen.features)
    return _Ballot(watched=seen, votes=votes, scenes=detector.scenes)


def _built(config: Mapping[str, Any], setting: Setting) -> tuple[Setting, Policy | SceneSlamError]:
    try:
        return setting, ComponentBuilder(_with(config, setting)).make("policy", Policy)
    except SceneSlamError as error:
        return setting, error


def _settings(axes: Sequence[Axis], prefix: str) -> Iterator[Setting]:
    own = [axis for axis in axes if axis.key.startswith(prefix)]
    for values in product(*(axis.values for axis in own)):
        yield dict(zip((axis.key for axis in own), values, strict=True))


def _place(node: Any, part: str) -> str | int:
    """Return a part of a key as its node needs it: an integer for lists."""
    return int(part) if isinstance(node, list) else part


def _with(config: Mapping[str, Any], setting: Setting) -> dict[str, Any]:
    """Return a copy of a configuration with the setting's values."""
    changed = {
        **config,
        "detector": deepcopy(config["detector"]),
        "policy": deepcopy(config["policy"]),
    }
    for key, value in setting.items():
        *path, name = key.split(".")
        node: Any = changed
        for part in path:
            node = node[_place(node, part)]
        node[_place(node, name)] = value
    return changed
