"""Threshold, hysteresis and window: which changes they confirm, from the votes' values alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.scene.scene_filter import WindowFilter
from sceneslam.modules.detectors.grey_mean import GreyMean
from sceneslam.types.experiment import TrialResult
from sceneslam.types.ranges import check_between, check_least, check_some

Votes = Sequence[tuple[int, NDArray[np.float64] | None]]  # stamp [ns], mean of grey


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """What a setting confirms, on average over the runs of a story."""

    story: str
    threshold: float
    hysteresis: float
    window_s: float
    changes: float  # scenes confirmed after the first


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """The settings that are tried, each with each."""

    thresholds: Sequence[float]
    hystereses: Sequence[float]
    windows_s: Sequence[float]

    def __post_init__(self) -> None:
        for name in ("thresholds", "hystereses", "windows_s"):
            check_some(**{name: getattr(self, name)})
        check_between(0, 255, thresholds=self.thresholds)
        check_least(0, hystereses=self.hystereses, windows_s=self.windows_s)


def sweep(outcomes: Sequence[TrialResult], grid: Grid) -> list[Setting]:
    """Return the confirmed changes per story, each story's votes read once per seed."""
    votes: dict[str, dict[str, Votes]] = {}
    for outcome in outcomes:
        story, _, seed = outcome.trial.name.split("/")
        if seed not in votes.setdefault(story, {}):
            votes[story][seed] = _read(outcome)
    settings = product(grid.thresholds, grid.hystereses, grid.windows_s)
    return [
        Setting(
            story=story,
            threshold=threshold,
            hysteresis=hysteresis,
            window_s=window_s,
            changes=float(
                np.mean([_changes(one, threshold, hysteresis, window_s) for one in runs.values()])
            ),
        )
        for threshold, hysteresis, window_s in settings
        for story, runs in votes.items()
    ]


def _read(outcome: TrialResult) -> Votes:
    with (outcome.folder / "events.jsonl").open() as file:
        events = [json.loads(line) for line in file if '"event": "vote"' in line]
    values = [(event["stamp_ns"], event["value"]) for event in events]
    return [(at, None if value is None else np.array([value])) for at, value in values]


def _changes(votes: Votes, threshold: float, hysteresis: float, window_s: float) -> int:
    detector = GreyMean(threshold=threshold, hysteresis=hysteresis, scenes=("Bright", "Dark"))
    scenes = WindowFilter(window_s=window_s, first_window_s=0.0)
    confirmed = [scenes.update(detector.decide(*vote)) for vote in votes]
    return sum(one is not None for one in confirmed) - 1
