"""The experiment `matrix`: story x strategy x seed.

`conf/experiment/matrix.yaml` says how it is called, `experiments/matrix.md` what was found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from sceneslam.experiments.matrix.cell import Cell, Strategy, judge, mean
from sceneslam.experiments.matrix.figure import draw_errors, draw_sweep
from sceneslam.experiments.matrix.oracle import best_of
from sceneslam.experiments.matrix.sweep import Grid, sweep
from sceneslam.types.experiment import Figure, Outcome, Relation, RunTrials, Table, Trial, Verdict
from sceneslam.types.ranges import check_above, check_among, check_between, check_least, check_some
from sceneslam.types.run import HANDOVERS
from sceneslam.types.trajectory import Trajectory

_ORACLE = Strategy(name="oracle")


class MatrixExperiment:
    """Compares hand-overs with every module alone and with an oracle."""

    def __init__(
        self,
        *,
        stories: Sequence[str],
        seeds: Sequence[int],
        modules: Sequence[str],
        handovers: Sequence[str],
        judged: str,
        regret_limit: float,
        thresholds: Sequence[float],
        hystereses: Sequence[float],
        windows_s: Sequence[float],
    ) -> None:
        check_some(stories=stories, seeds=seeds, modules=modules, handovers=handovers)
        check_some(thresholds=thresholds, hystereses=hystereses, windows_s=windows_s)
        check_among(HANDOVERS, handovers=handovers)
        check_among(handovers, judged=judged)
        check_least(0, seeds=seeds, hystereses=hystereses, windows_s=windows_s)
        check_between(0, 255, thresholds=thresholds)
        check_above(0, regret_limit=regret_limit)
        self._places = [(story, seed) for story in stories for seed in seeds]
        self._alone = [Strategy(name=f"{key} alone", module=key) for key in modules]
        self._strategies = [
            *self._alone,
            *(Strategy(name=kind, handover=kind) for kind in handovers),
        ]
        self._judged, self._regret_limit = judged, regret_limit
        self._grid = Grid(thresholds=thresholds, hystereses=hystereses, windows_s=windows_s)

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run every cell; return the table over stories and what holds of `rewind`."""
        pairs = [(place, strategy) for place in self._places for strategy in self._strategies]
        outcomes = list(run_trials(_trial(*pair) for pair in pairs))
        cells: list[Cell] = []
        count = len(self._strategies)
        for number, (story, seed) in enumerate(self._places):
            group = outcomes[number * count : (number + 1) * count]
            cells += [
                Cell.of(story, seed, strategy.name, one)
                for strategy, one in zip(self._strategies, group, strict=True)
            ]
            cells.append(self._oracle(story, seed, group))
        means = mean(cells)
        draw_errors(folder / "errors.png", means)
        draw_sweep(folder / "sweep.png", sweep(outcomes, self._grid))
        return Verdict(
            figures=list(self._figures(means)),
            table=_table(means),
            pictures={
                "errors.png": "The error of every strategy, story by story.",
                "sweep.png": "Which changes a threshold, hysteresis and window confirm.",
            },
        )

    def _oracle(self, story: str, seed: int, group: Sequence[Outcome]) -> Cell:
        truth = Trajectory.read_tum(group[0].folder / "groundtruth.tum")
        alone = [outcome.trajectory for outcome in group[: len(self._alone)]]
        return judge(story, seed, _ORACLE.name, best_of(alone, truth), truth)

    def _figures(self, means: Sequence[Cell]) -> Iterator[Figure]:
        regrets = []
        for story in dict.fromkeys(cell.story for cell in means):
            of = {cell.strategy: cell for cell in means if cell.story == story}
            ours, oracle = of[self._judged], of[_ORACLE.name]
            yield Figure(
                name=f"{story}: Correct Rate of {self._judged}, and of the best module alone",
                value=ours.correct_rate,
                relation=Relation.AT_LEAST,
                bound=max(of[one.name].correct_rate for one in self._alone),
            )
            regrets.append(ours.ate_m / oracle.ate_m - 1.0)
            if story == "flicker":
                yield _at_most("flicker: switches", ours.switches, 0.0)
        yield _at_most(
            "regret against the oracle, mean", float(np.mean(regrets)), self._regret_limit
        )


def _at_most(name: str, value: float, bound: float) -> Figure:
    return Figure(name=name, value=value, relation=Relation.AT_MOST, bound=bound)


def _trial(place: tuple[str, int], strategy: Strategy) -> Trial:
    story, seed = place
    overrides = [f"story={story}", f"seed={seed}", f"policy.handover={strategy.handover}"]
    if strategy.module:
        overrides.append(f"scenes={{Bright: [{strategy.module}], Dark: [{strategy.module}]}}")
    name = f"{story}/{strategy.name.replace(' ', '_')}/{seed}"
    return Trial(name=name, overrides=tuple(overrides))


def _table(means: Sequence[Cell]) -> Table:
    columns = ("story", "strategy", "ATE [cm]", "correct [%]", "coverage [%]", "switches", "false")
    rows = [
        (
            one.story,
            one.strategy,
            100 * one.ate_m,
            100 * one.correct_rate,
            100 * one.coverage,
            one.switches,
            one.false_switches,
        )
        for one in means
    ]
    return Table(columns=columns, rows=rows)
