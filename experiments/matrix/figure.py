"""The matrix as bars, and the sweep as a map of confirmed changes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneslam.evaluation import figure_style as look
from sceneslam.experiments.matrix.cell import Cell
from sceneslam.experiments.matrix.sweep import Setting


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
    look.style(axes, x_label="ATE RMSE [cm]")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=11)
    look.save(figure, path)


def draw_sweep(path: Path, settings: Sequence[Setting]) -> None:
    """Write a PNG: one map per story of how many changes threshold and window confirm."""
    stories = list(dict.fromkeys(one.story for one in settings))
    thresholds = sorted({one.threshold for one in settings})
    windows_s = sorted({one.window_s for one in settings})
    columns = 2
    rows = -(-len(stories) // columns)
    figure = look.new_figure(height_in=2.4 * rows)
    for number, story in enumerate(stories):
        axes = figure.add_subplot(rows, columns, number + 1)
        of = {(s.threshold, s.window_s): s.changes for s in settings if s.story == story}
        counts = np.array([[of[t, w] for w in windows_s] for t in thresholds])
        axes.imshow(counts, cmap="cividis", aspect="auto", origin="lower", vmin=0)
        for (row, column), count in np.ndenumerate(counts):
            color = "white" if count < counts.max() / 2 or not counts.max() else "black"
            axes.text(column, row, f"{count:g}", ha="center", va="center", color=color, fontsize=8)
        axes.set_xticks(range(len(windows_s)), [f"{w:g}" for w in windows_s], fontsize=8)
        axes.set_yticks(range(len(thresholds)), [f"{t:g}" for t in thresholds], fontsize=8)
        axes.set_title(story, fontsize=10)
    figure.supxlabel("window [s]", fontsize=11)
    figure.supylabel("threshold", fontsize=11)
    look.save(figure, path)
