"""Several trajectories over one path, from above (the paper's Fig. 8)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import covered, interpolated
from sceneslam.evaluation.figures import style as look
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import TRUTH_GAP_S

_MARGIN = 0.08  # of the true path's extent: paths beyond it are cut off
_STYLES = ("-", "--", "-.")


def draw_paths(path: Path, paths: Mapping[str, Trajectory], truth: Trajectory | None) -> None:
    """Write a PNG with every path from above, in `map`; the true one is dashed.

    The truth is aligned to the first trajectory by one pose only: the first that the truth covers.
    It is not drawn if it covers none.
    """
    first = next((one for one in paths.values() if len(one)), Trajectory.empty())
    true_m = _true_m(first, truth)
    spread = true_m if len(true_m) else first.positions_m[:, :2]
    if not len(spread):
        return
    low, high = spread.min(axis=0), spread.max(axis=0)
    margin_m = _MARGIN * float((high - low).max()) + 0.3
    low, high = low - margin_m, high + margin_m
    ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.45, 1.3))
    figure = look.new_figure(look.WIDTH_IN, look.WIDTH_IN * ratio + 1.2)
    axes = figure.add_subplot()
    for number, (name, one) in enumerate(paths.items()):
        color = look.PALETTE[number % len(look.PALETTE)]
        line = _STYLES[number // len(look.PALETTE) % len(_STYLES)]
        axes.plot(*one.positions_m[:, :2].T, line, color=color, linewidth=1.6, label=name)
    if len(true_m):
        axes.plot(
            *true_m.T, color=look.INK, linewidth=0.9, dashes=(4, 4), label="ground truth", zorder=5
        )
    look.style(axes, x_label="x [m]", y_label="y [m]")
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    figure.legend(loc="outside lower center", ncols=3, fontsize=11, frameon=False)
    look.save(figure, path)


def _true_m(first: Trajectory, truth: Trajectory | None) -> NDArray[np.float64]:
    """Return the true positions (N, 2) [m] in the frame of a trajectory."""
    if truth is None:
        return np.zeros((0, 2))
    known = covered(truth, first.stamps_ns, TRUTH_GAP_S)[:1]
    if not len(known):
        return np.zeros((0, 2))
    T_gt_known = interpolated(truth, first.stamps_ns[known]).T_world_base[0]
    T_map_gt = first.T_world_base[known[0]] @ se3.inverse(T_gt_known)
    return np.asarray(se3.apply(T_map_gt, truth.positions_m)[:, :2])
