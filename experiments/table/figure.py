"""The evidence as bars: what a second with each module costs, scene by scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.table.evidence import Evidence


def draw_scores(path: Path, evidence: Sequence[Evidence], *, interval_s: float) -> None:
    """Write a PNG: the score of every module, on a log scale, with its share of poses."""
    modules = list(dict.fromkeys(one.module for one in evidence))
    colors = {key: look.PALETTE[n % len(look.PALETTE)] for n, key in enumerate(modules)}
    figure = look.new_figure(height_in=1.2 + 0.3 * len(evidence))
    axes = figure.add_subplot()
    names = []
    for row, one in enumerate(evidence):
        axes.barh(row, 100 * one.score_m, 0.7, color=colors[one.module])
        label = f"{100 * one.available:.0f} % available"
        axes.annotate(
            label, (100 * one.score_m, row), (4, 0), textcoords="offset points", va="center"
        )
        names.append(f"{one.scene}: {one.module}")
    axes.set_yticks(range(len(evidence)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.margins(x=0.5)
    look.style(axes, x_label=f"error over {interval_s:g} s, lost ones included [cm]")
    look.save(figure, path)
