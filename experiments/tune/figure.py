"""The search: the score of every trial, and the best so far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneslam.evaluation.figures import style as look


def draw_search(path: Path, scores: Sequence[float], *, default: float) -> None:
    """Write a PNG of scores over trials, beside the score of the defaults."""
    numbers = np.arange(1, len(scores) + 1)
    figure = look.new_figure()
    axes = figure.add_subplot()
    axes.plot(numbers, scores, "o", color=look.PALETTE[5], markersize=4, label="trial")
    best = np.minimum.accumulate(scores)
    axes.step(numbers, best, where="post", color=look.PALETTE[0], label="best so far")
    axes.axhline(default, color=look.PALETTE[1], linestyle="--", label="defaults")
    low = min(best[-1], default)
    if max(scores) > 20 * low > 0:
        axes.set_yscale("log")
    look.style(axes, x_label="trial", y_label="score, train")
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=11)
    look.save(figure, path)
