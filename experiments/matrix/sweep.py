"""Threshold against window: false confirmations and delay, from the votes' values alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneslam.bus.scene_filter import SceneFilter
from sceneslam.types.experiment import Outcome
from sceneslam.types.observation import UNSURE, SceneVote


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What a threshold and a window confirm, on average over the runs of a story."""

    story: str
    threshold: float
    window_s: float
    changes: float  # scenes confirmed after the first


def sweep(
    outcomes: Sequence[Outcome], thresholds: Sequence[float], windows_s: Sequence[float]
) -> list[Setting]:
    """Return the confirmed changes per story, each story's votes read once per seed."""
    votes: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for outcome in outcomes:
        story, _, seed = outcome.trial.name.split("/")
        if seed not in votes.setdefault(story, {}):
            votes[story][seed] = _values(outcome)
    return [
        Setting(
            story=story,
            threshold=threshold,
            window_s=window_s,
            changes=float(np.mean([_changes(one, threshold, window_s) for one in runs.values()])),
        )
        for story, runs in votes.items()
        for threshold in thresholds
        for window_s in windows_s
    ]


def _values(outcome: Outcome) -> list[tuple[int, float]]:
    with (outcome.folder / "events.jsonl").open() as file:
        events = [json.loads(line) for line in file if '"event": "vote"' in line]
    values = [(event["stamp_ns"], event["value"]) for event in events]
    return [(stamp_ns, float("nan") if value is None else value) for stamp_ns, value in values]


def _changes(votes: Sequence[tuple[int, float]], threshold: float, window_s: float) -> int:
    scenes = SceneFilter(window_s=window_s, first_window_s=0.0)
    confirmed = 0
    for stamp_ns, value in votes:
        scene = UNSURE if np.isnan(value) else "Bright" if value > threshold else "Dark"
        confirmed += scenes.update(SceneVote(stamp_ns=stamp_ns, scene=scene)) is not None
    return confirmed - 1
