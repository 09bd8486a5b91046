"""The rates as a bar chart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.openloris.rates import Rates

_WIDTH = 0.27  # of a bar; three stand together
_NAMES = {
    "ds-slam": "DS-SLAM",
    "orbslam2_rgbd": "ORB-SLAM2 RGB-D",
    "vins_mono_color_imu_with_loop": "VINS-Mono colour",
    "vins_mono_fisheye_imu_with_loop": "VINS-Mono fisheye",
}


def draw_rates(path: Path, rates: Sequence[Rates]) -> None:
    """Write a PNG with three bars per entry: alone, odometry, together."""
    figure = look.new_figure(height_in=1.2 + 0.55 * len(rates))
    axes = figure.add_subplot()
    for number, column in enumerate(("alone", "odometry", "together")):
        values = [getattr(one, column) for one in rates]
        at = [row + (number - 1) * _WIDTH for row in range(len(rates))]
        axes.barh(at, values, _WIDTH, color=look.PALETTE[number], label=column)
    labels = [f"{_NAMES.get(one.system, one.system)}\n{one.name}" for one in rates]
    axes.set_yticks(range(len(rates)), labels)
    axes.set_ylim(len(rates) - 0.5, -0.5)  # the first at the top
    axes.set_xlim(0, 100)
    look.style(axes, x_label="Correct Rate [%]")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, fontsize=11)
    look.save(figure, path)
