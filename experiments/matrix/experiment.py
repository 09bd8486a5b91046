"""The experiment `matrix`: stories x strategies x seeds. The experiment `tour` is one of these.

`conf/experiment/matrix.yaml` and `tour.yaml` say how they are called, `experiments/matrix.md` and
`tour.md` what was found.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from sceneslam.evaluation.correctness import CorrectLimits
from sceneslam.evaluation.figures.paths import draw_paths
from sceneslam.experiments.matrix.cell import Cell, Judge, deviation, mean, rows_of
from sceneslam.experiments.matrix.figure import draw_errors, draw_sweep
from sceneslam.experiments.matrix.oracle import best_of
from sceneslam.experiments.matrix.promises import Promises
from sceneslam.experiments.matrix.sweep import Grid, sweep
from sceneslam.types.experiment import RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_among, check_least, check_some
from sceneslam.types.trajectory import Trajectory

ORACLE = "oracle"
_COLUMNS = {  # of the table: (field, factor, digits)
    "coverage [%]": ("coverage", 100.0, 1),
    "correct [%]": ("correct_rate", 100.0, 1),
    "error per {segment_m:g} m [cm]": ("segment_m", 100.0, 2),
    "ATE [cm]": ("ate_m", 100.0, 2),
    "switches": ("switches", 1.0, 1),
    "false": ("false_switches", 1.0, 1),
    "regret": ("regret", 1.0, 2),
}


class MatrixExperiment:
    """Compares strategies with every module alone and with an oracle.

    A strategy is what it overrides in the configuration; a module alone is asked for in every scene
    of the table `scenes`, with the overrides `alone`.
    """

    def __init__(
        self,
        *,
        stories: Sequence[str],
        seeds: Sequence[int],
        modules: Sequence[str],
        scenes: Mapping[str, Sequence[str]],
        alone: Sequence[str],
        strategies: Mapping[str, Sequence[str]],
        piece_s: float,
        correct_limits: Mapping[str, float],
        segment_m: float,
        promises: Mapping[str, Any],
        votes: Mapping[str, Sequence[float]] | None,
    ) -> None:
        check_some(stories=stories, seeds=seeds, modules=modules, strategies=strategies)
        check_least(0, seeds=seeds)
        check_above(0, piece_s=piece_s, segment_m=segment_m)
        self._places = list(product(stories, seeds))
        self._alone = [f"{key} alone" for key in modules]
        tables = {key: ", ".join(f"{scene}: [{key}]" for scene in scenes) for key in modules}
        self._strategies = {
            **{f"{key} alone": [*alone, f"scenes={{{tables[key]}}}"] for key in modules},
            **strategies,
        }
        self._piece_s = piece_s
        self._judge = Judge(limits=CorrectLimits(**correct_limits), segment_m=segment_m)
        self._promises = Promises(**promises)
        check_among([*strategies], judged=self._promises.judged)
        self._grid = None if votes is None else Grid(**votes)

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run every cell; return the table over stories and what holds of the judged strategy."""
        pairs = list(product(self._places, self._strategies))
        outcomes = list(run_trials([self._trial(*pair) for pair in pairs]))
        count = len(self._strategies)
        groups = [
            dict(zip(self._strategies, outcomes[k * count : (k + 1) * count], strict=True))
            for k in range(len(self._places))
        ]
        oracles = [self._oracle(group) for group in groups]
        cells = [
            cell
            for place, group, oracle in zip(self._places, groups, oracles, strict=True)
            for cell in self._cells(*place, group, oracle)
        ]
        with (folder / "cells.csv").open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows_of(cells))
        return Verdict(
            figures=list(self._promises.figures(cells, self._alone)),
            table=_table(cells, self._judge.segment_m),
            pictures=self._draw(folder, cells, groups[0], oracles[0], outcomes),
        )

    def _trial(self, place: tuple[str, int], strategy: str) -> Trial:
        story, seed = place
        name = f"{story}/{strategy.replace(' ', '_')}/{seed}"
        overrides = (f"story={story}", f"seed={seed}", *self._strategies[strategy])
        return Trial(name=name, overrides=overrides)

    def _oracle(self, group: Mapping[str, TrialResult]) -> Trajectory:
        alone = [group[name] for name in self._alone]
        estimates = [one for run in alone for one in (run.online, run.trajectory)]
        best: Trajectory = best_of(estimates, _truth(group), self._piece_s, self._judge.segment_m)
        return best

    def _cells(
        self, story: str, seed: int, group: Mapping[str, TrialResult], oracle: Trajectory
    ) -> Iterator[Cell]:
        best = self._judge.cell(story, seed, ORACLE, oracle, _truth(group))
        most = max(outcome.metrics["observations"] for outcome in group.values())
        for name, outcome in group.items():
            yield Cell.of(story, seed, name, outcome, observations=most).beside(best)
        yield best

    def _draw(
        self,
        folder: Path,
        cells: Sequence[Cell],
        group: Mapping[str, TrialResult],
        oracle: Trajectory,
        outcomes: Sequence[TrialResult],
    ) -> dict[str, str]:
        """Draw the pictures; return them with their captions."""
        draw_errors(folder / "errors.png", mean(cells))
        paths = {**{name: one.trajectory for name, one in group.items()}, ORACLE: oracle}
        draw_paths(folder / "paths.png", paths, _truth(group))
        pictures = {
            "errors.png": "The error of every strategy, story by story.",
            "paths.png": "Every strategy's path from above: the first story, the first seed.",
        }
        if self._grid is not None:
            draw_sweep(folder / "sweep.png", sweep(outcomes, self._grid))
            pictures["sweep.png"] = "Which changes a threshold, hysteresis and window confirm."
        return pictures


def _truth(group: Mapping[str, TrialResult]) -> Trajectory:
    first = next(iter(group.values()))
    return Trajectory.read_tum(first.folder / "groundtruth.tum")


def _table(cells: Sequence[Cell], segment_m: float) -> Table:
    """Return the means over the seeds, a row per story and strategy, and of several the spread."""
    means, deviations = mean(cells), deviation(cells)
    has_spread = len({cell.seed for cell in cells}) > 1

    def shown(at: int, name: str, scale: float, digits: int) -> str:
        middle, spread = (scale * getattr(one[at], name) for one in (means, deviations))
        if math.isnan(middle):
            return "-"
        return f"{middle:.{digits}f}" + (f" ± {spread:.{digits}f}" if has_spread else "")

    rows = [
        (one.story, one.strategy, *(shown(at, *how) for how in _COLUMNS.values()))
        for at, one in enumerate(means)
    ]
    columns = [name.format(segment_m=segment_m) for name in _COLUMNS]
    return Table(columns=("story", "strategy", *columns), rows=rows)
