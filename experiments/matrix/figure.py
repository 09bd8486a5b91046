"""The matrix as bars, and the sweep as a map of confirmed changes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.matrix.cell import Cell
from sceneslam.experiments.matrix.sweep import Setting

_TICKS_CM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)


def draw_errors(path: Path, means: Sequence[Cell]) -> None:
    """Write a PNG: the error of every strategy, story by story, on a log scale."""
    stories = list(dict.fromkeys(cell.story for cell in means))
    strategies = list(dict.fromkeys(cell.strategy for cell in means))
    width = 0.8 / len(strategies)
    figure = look.new_figure(height_in=1.5 + 0.8 * len(stories))
    axes = figure.add_subplot()
    for number, strategy in enumerate(strategies):
        of = {cell.story: 100 * cell.ate_m for cell in means if cell.strategy == strategy}
        at = np.arange(len(stories)) + (number - (len(strategies) - 1) / 2) * width
        color = look.PALETTE[number % len(look.PALETTE)]
        axes.barh(at, [of[story] for story in stories], width, color=color, label=strategy)
    axes.set_yticks(range(len(stories)), stories)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xticks(_TICKS_CM, [f"{tick:g}" for tick in _TICKS_CM])
    axes.minorticks_off()
    errors_cm = [100 * cell.ate_m for cell in means]
    axes.set_xlim(0.8 * np.nanmin(errors_cm), 1.2 * np.nanmax(errors_cm))
    look.style(axes, x_label="ATE RMSE [cm]")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=11)
    look.save(figure, path)


def draw_sweep(path: Path, settings: Sequence[Setting]) -> None:
    """Write a PNG: how many changes are confirmed, a map per story and hysteresis."""
    stories = list(dict.fromkeys(one.story for one in settings))
    hystereses = list(dict.fromkeys(one.hysteresis for one in settings))
    maps = [(story, hysteresis) for story in stories for hysteresis in hystereses]
    columns = 2 * len(hystereses)
    rows = -(-len(maps) // columns)
    figure = look.new_figure(height_in=2.0 * rows + 0.5)
    for number, (story, hysteresis) in enumerate(maps):
        axes = figure.add_subplot(rows, columns, number + 1)
        axes.set_title(f"{story}, {hysteresis:g}", fontsize=8)
        chosen = [s for s in settings if (s.story, s.hysteresis) == (story, hysteresis)]
        _draw_map(axes, chosen, most=max(s.changes for s in settings if s.story == story))
    figure.supxlabel("window [s]", fontsize=11)
    figure.supylabel("threshold (beside the story: hysteresis)", fontsize=11)
    look.save(figure, path)


def _draw_map(axes: Any, settings: Sequence[Setting], *, most: float) -> None:
    thresholds = sorted({one.threshold for one in settings})
    windows_s = sorted({one.window_s for one in settings})
    of = {(one.threshold, one.window_s): one.changes for one in settings}
    counts = np.array([[of[t, w] for w in windows_s] for t in thresholds])
    axes.imshow(counts, cmap="cividis", aspect="auto", origin="lower", vmin=0, vmax=max(most, 1))
    for (row, column), count in np.ndenumerate(counts):
        color = "white" if count < max(most, 1) / 2 else "black"
        text = f"{count:.0f}" if count >= 10 else f"{count:.2g}"
        axes.text(column, row, text, ha="center", va="center", color=color, fontsize=6)
    axes.set_xticks(range(len(windows_s)), [f"{w:g}" for w in windows_s], fontsize=5)
    axes.set_yticks(range(len(thresholds)), [f"{t:g}" for t in thresholds], fontsize=6)
