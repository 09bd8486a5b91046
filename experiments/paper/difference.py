"""IV-D: the same path with and without switching, and how far the two are apart (Fig. 8)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.comparison import Difference, compare
from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.paper.runs import number
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_some


class DifferenceExperiment:
    """Compares the switched run of stories with one module that has all lights on.

    `difference_max_m` names the stories, each with its bound.
    """

    def __init__(self, *, lit_module: str, difference_max_m: Mapping[str, float]) -> None:
        check_some(difference_max_m=difference_max_m)
        check_above(0, difference_max_m=difference_max_m)
        self._stories, self._lit_module = [*difference_max_m], lit_module
        self._difference_max_m = difference_max_m

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return the largest difference of every story; it counts over the whole path only."""
        table = f"scenes={{Bright: [{self._lit_module}], Dark: [{self._lit_module}]}}"
        outcomes = run_trials(
            Trial(name=f"{story}/{name}", overrides=(f"story={story}", *overrides))
            for story in self._stories
            for name, overrides in (("switched", ()), ("unswitched", ("lights=on", table)))
        )
        pairs = dict(zip(self._stories, zip(outcomes, outcomes, strict=True), strict=True))
        found = {
            name: compare(a.trajectory, b.trajectory, a.metrics["association_gap_s"])
            for name, (a, b) in pairs.items()
        }
        draw_differences(folder / "difference.png", found)
        figures = []
        for name, one in found.items():
            share, bound_m = _share(one, pairs[name][0]), self._difference_max_m[name]
            figures.append(Figure.at_least(f"{name}: poses compared", share, 1.0))
            figures.append(Figure.at_most(f"{name}: largest difference", one.max_m, bound_m, "m"))
        columns = ("story", "largest difference [cm]", "RMS [cm]", "poses compared")
        errors = ("ATE switched [cm]", "ATE unswitched [cm]")
        rows = [_row(name, one, *pairs[name]) for name, one in found.items()]
        return Verdict(
            figures=figures,
            table=Table(columns=(*columns, *errors), rows=rows),
            pictures={"difference.png": "How far the two runs are apart, over time."},
        )


def draw_differences(path: Path, found: Mapping[str, Difference]) -> None:
    """Write a PNG: the distance between the two runs over time, a line per story."""
    figure = look.new_figure()
    axes = figure.add_subplot()
    for number_, (name, one) in enumerate(found.items()):
        if len(one.stamps_ns):
            color = look.PALETTE[number_ % len(look.PALETTE)]
            axes.plot(_elapsed_s(one), 100 * one.differences_m, color=color, label=name)
    look.style(axes, y_label="difference [cm]")
    axes.set_ylim(bottom=0.0)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=11)
    look.save(figure, path)


def _elapsed_s(one: Difference) -> NDArray[np.float64]:
    return np.asarray((one.stamps_ns - one.stamps_ns[0]) * 1e-9)


def _share(one: Difference, run: TrialResult) -> float:
    """Return the share of a run's observations at which both runs have a pose."""
    return len(one.stamps_ns) / max(1.0, float(run.metrics["observations"]))


def _row(
    name: str, one: Difference, switched: TrialResult, unswitched: TrialResult
) -> tuple[str | float, ...]:
    ates = (100 * number(run.metrics["ate_rmse_m"]) for run in (switched, unswitched))
    return (name, 100 * one.max_m, 100 * one.rms_m, float(len(one.stamps_ns)), *ates)
