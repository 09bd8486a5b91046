"""Figures of several runs: paths from above, and errors over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneslam.compare.runs import Run
from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.comparison import placed_in_map
from sceneslam.evaluation.figures import style as look
from sceneslam.evaluation.figures.paths import draw_paths


def paths(path: Path, runs: Sequence[Run]) -> bool:
    """Draw all paths from above, in the map of the first, as a PNG; False if no run has a pose."""
    first = next((run for run in runs if len(run.trajectory)), None)
    if first is None:
        return False
    placed = {
        run.name: placed_in_map(run.trajectory, first.trajectory, run.metrics["association_gap_s"])
        for run in runs
    }
    draw_paths(path, placed, first.truth)
    return True


def errors(path: Path, runs: Sequence[Run]) -> bool:
    """Draw the position error of every run over time as a PNG; False without ground truth."""
    figure = look.new_figure(look.WIDTH_IN, 3.6)
    axes = figure.add_subplot()
    is_drawn = False
    for number, run in enumerate(runs):
        if run.truth is None:
            continue
        found = absolute_errors(run.trajectory, run.truth, run.metrics["association_gap_s"])
        if not len(found.errors_m):
            continue
        times_s = (found.stamps_ns - run.metrics["start_ns"]) * 1e-9
        color = look.PALETTE[number % len(look.PALETTE)]
        drawn = look.thinned(times_s, np.asarray(found.errors_m))
        axes.plot(*drawn, color=color, linewidth=1.3, label=run.name)
        is_drawn = True
    if is_drawn:
        look.style(axes, y_label="position error [m]")
        axes.set_ylim(bottom=0.0)
        figure.legend(loc="outside lower center", ncols=2, fontsize=11, frameon=False)
        look.save(figure, path)
    return is_drawn
