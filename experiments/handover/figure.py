"""The seams as bars: what each kind of hand-over lost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.handover.seam import Seam


def draw_seams(path: Path, seams: Sequence[Seam]) -> None:
    """Write a PNG with a group of bars per start and loss, one bar per kind, on a log scale."""
    kinds = list(dict.fromkeys(seam.kind for seam in seams))
    groups = list(dict.fromkeys((seam.startup_s, seam.lost_s) for seam in seams))
    width = 0.8 / len(kinds)
    figure = look.new_figure(height_in=3.6)
    axes = figure.add_subplot()
    for number, kind in enumerate(kinds):
        values = {(s.startup_s, s.lost_s): 100 * s.error_m for s in seams if s.kind == kind}
        at = [row + (number - (len(kinds) - 1) / 2) * width for row in range(len(groups))]
        heights = [values[group] for group in groups]
        axes.bar(at, heights, width, color=look.PALETTE[number], label=kind)
    labels = [f"{startup_s:g} s\n{lost_s:g} s" for startup_s, lost_s in groups]
    axes.set_xticks(range(len(groups)), labels)
    axes.set_yscale("log")
    look.style(axes, x_label="start-up; lost before", y_label="motion error [cm]")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=11)
    look.save(figure, path)
