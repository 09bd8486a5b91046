"""Builds everything a run needs from its configuration, and checks that the parts fit together."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from hydra.errors import InstantiationException
from hydra.utils import instantiate

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.policy import Policy
from sceneslam.config.check import NOTHING, check_keys, check_node, first_line
from sceneslam.config.settings import RunSettings
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.interfaces import Detector, Sink, SlamModule, Source
from sceneslam.sources.ordered import Ordered
from sceneslam.types.errors import ConfigError, SceneSlamError
from sceneslam.types.rig import Rig, Sensor

Part = TypeVar("Part")
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """All that a run is made of."""

    source: Source
    rig: Rig
    detector: Detector
    modules: Mapping[str, SlamModule]
    scenes: Mapping[str, Sequence[str]]
    policy: Policy
    atlas: Atlas
    sinks: Mapping[str, Sink]
    evaluation: EvaluationSettings
    run: RunSettings
    threshold: float | None  # of the detector, for the figures


def build(config: Mapping[str, Any]) -> Parts:
    """Return all parts; raises ConfigError or InputError naming what does not fit."""
    check_keys(config)
    builder = _Builder(config)
    run = builder.make("run", RunSettings)
    policy = builder.make("policy", Policy)
    detector = builder.make("detector", Detector)
    scenes = _table(config, detector)
    modules = {key: builder.make(f"slam.{key}", SlamModule) for key in _used(scenes)}
    atlas = builder.make("atlas", Atlas)
    evaluation = builder.make("evaluation", EvaluationSettings)
    sinks = {key: builder.make(f"sinks.{key}", Sink) for key in config.get("sinks") or {}}
    source = builder.make("source", Source)
    if config.get("effects"):
        source = builder.make("effects", Source, source)
    source = Ordered(source)
    rig = source.rig
    _check_sensors("detector", config["detector"], detector.requires, rig)
    for key, module in modules.items():
        _check_sensors(f"slam.{key}", config["slam"][key], module.requires, rig)
    return Parts(
        source=source,
        rig=rig,
        detector=detector,
        modules=modules,
        scenes=scenes,
        policy=policy,
        atlas=atlas,
        sinks=sinks,
        evaluation=evaluation,
        run=run,
        threshold=config["detector"].get("threshold"),
    )


class _Builder:
    """Makes single components of one configuration."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        allow = config.get("allow_targets") or []
        if not isinstance(allow, list) or not all(isinstance(item, str) for item in allow):
            raise ConfigError("allow_targets", allow, "a list of package names")
        self._allow = allow

    def make(self, key: str, kind: type[Part], *arguments: object) -> Part:
        """Return the component at a dotted key; it must have all members of `kind`."""
        node: Any = self._config
        for name in key.split("."):
            node = node.get(name) if isinstance(node, Mapping) else None
        if node is None:
            raise ConfigError(key, NOTHING, "a component: `_target_` and its arguments")
        check_node(node, key, allow=self._allow, positional=len(arguments))
        part = self._instantiate(node, key, arguments)
        missing = [name for name in _members(kind) if name not in dir(part)]
        if missing:
            needs = f"a {kind.__name__}, which has: {', '.join(missing)}"
            raise ConfigError(key, node["_target_"], needs)
        return cast(Part, part)

    def _instantiate(
        self, node: Mapping[str, Any], key: str, arguments: tuple[object, ...]
    ) -> object:
        try:
            return instantiate(node, *arguments, _convert_="all")
        except InstantiationException as error:
            cause = error.__cause__
            if isinstance(cause, ConfigError):
                raise cause.under(key) from error
            if isinstance(cause, SceneSlamError):
                raise cause from error
            reason = first_line(cause or error)
            raise ConfigError(key, node["_target_"], f"a target that builds ({reason})") from error


def _members(kind: type) -> list[str]:
    """Return the public names that a Protocol or class asks for."""
    return [name for name in vars(kind) if not name.startswith("_")]


def _table(config: Mapping[str, Any], detector: Detector) -> dict[str, tuple[str, ...]]:
    """Return scene -> module keys after checking it against the detector and `slam`."""
    modules = [key for key, node in (config.get("slam") or {}).items() if node is not None]
    if not modules:
        raise ConfigError("slam", NOTHING, "SLAM modules; choose a scenario: +scenario=single")
    known = f"a list of keys of slam: {', '.join(modules)}"
    table = config.get("scenes") or {}
    for scene in detector.scenes:
        if scene not in table:
            raise ConfigError(f"scenes.{scene}", NOTHING, known)
    for scene, keys in table.items():
        is_list = isinstance(keys, list) and len(keys) > 0
        if not is_list or not all(key in modules for key in keys) or len(set(keys)) < len(keys):
            raise ConfigError(f"scenes.{scene}", keys, f"{known}, each once")
    scenes = {scene: tuple(table[scene]) for scene in detector.scenes}
    for key in modules:
        if key not in _used(scenes):
            _log.warning("slam.%s: no scene names it, so it does not run", key)
    return scenes


def _used(scenes: Mapping[str, Sequence[str]]) -> list[str]:
    """Return every module key of the table, each once."""
    return list(dict.fromkeys(key for keys in scenes.values() for key in keys))


def _check_sensors(
    key: str, node: Mapping[str, Any], requires: Sequence[frozenset[Sensor]], rig: Rig
) -> None:
    """Raise ConfigError when the source lacks the sensors that a component needs."""
    if any(sensors <= rig.sensors for sensors in requires):
        return
    needs = " or ".join(_names(sensors) for sensors in requires)
    name = str(node["_target_"]).rpartition(".")[2]
    raise ConfigError(key, name, f"a source with {needs}; this one has: {_names(rig.sensors)}")


def _names(sensors: frozenset[Sensor]) -> str:
    return " + ".join(sorted(sensor.value for sensor in sensors))
