"""The trajectory itself: position and heading over time, and the path coloured by its error."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import AbsoluteErrors
from sceneslam.evaluation.figures import style as look
from sceneslam.types.run import RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_FLAT_M = 0.05  # a path that rises by less is not drawn upwards
_PIECES = 600  # of the path, each in the colour of its largest error
_TURN_DEG = 180.0  # between two samples: the heading went through +-180, no line is drawn


def draw_pose(result: RunResult, truth: GroundTruth | None, T_map_gt: Transform | None) -> Any:
    """Return x, y, z [m] and yaw [deg] in `map` over time, the true ones dashed; None if no pose.

    z is left out where the path is flat. `T_map_gt` places the ground truth; None draws none.
    """
    if len(result.trajectory) < 2:
        return None
    estimated = _rows(result.trajectory.T_world_base)
    true = np.zeros((4, 0))
    if truth is not None and T_map_gt is not None and len(truth.trajectory):
        within = _within(truth.trajectory, result.trajectory)
        true_s = look.elapsed_s(result, truth.trajectory.stamps_ns[within])
        true = _rows(T_map_gt @ truth.trajectory.T_world_base[within])
    is_flat = np.ptp(np.concatenate([estimated[2], true[2]])) < _FLAT_M
    shown = [0, 1, 3] if is_flat else [0, 1, 2, 3]
    times_s = look.elapsed_s(result, result.trajectory.stamps_ns)
    figure = look.new_figure(look.WIDTH_IN, 1.2 + 1.25 * len(shown))
    all_axes = figure.subplots(len(shown), sharex=True)
    for axes, row in zip(all_axes, shown, strict=True):
        curve = look.thinned(times_s, _cut(estimated[row], row))
        axes.plot(*curve, color=look.PALETTE[0], linewidth=1.4, label="estimate")
        if true.shape[1]:
            curve = look.thinned(true_s, _cut(true[row], row))
            axes.plot(*curve, color=look.INK, linewidth=0.9, dashes=(4, 4), label="ground truth")
        is_last = row == shown[-1]
        name = ("x [m]", "y [m]", "z [m]", "yaw [deg]")[row]
        look.style(axes, x_label="time [s]" if is_last else "", y_label=name)
    all_axes[0].set_xlim(0.0, max(look.duration_s(result), 1e-3))
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=11, frameon=False)
    figure.align_ylabels(all_axes)
    return figure


def draw_error_path(result: RunResult, errors: AbsoluteErrors) -> Any:
    """Return the path from above, its colour the position error; None without ground truth."""
    from matplotlib.collections import LineCollection

    at = np.searchsorted(result.trajectory.stamps_ns, errors.stamps_ns)
    if len(at) < 2:
        return None
    starts = np.unique(np.linspace(0, len(at), _PIECES, endpoint=False).astype(int))
    path = result.trajectory.positions_m[at[np.append(starts, len(at) - 1)], :2]
    figure = look.new_figure(look.WIDTH_IN, look.WIDTH_IN * 0.8)
    axes = figure.add_subplot()
    pieces = list(np.stack([path[:-1], path[1:]], axis=1))
    line = LineCollection(pieces, cmap="viridis", linewidths=3.0)
    line.set_array(np.maximum.reduceat(errors.errors_m, starts))
    axes.add_collection(line)
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    look.style(axes, x_label="x [m]", y_label="y [m]")
    bar = figure.colorbar(line, ax=axes, shrink=0.8)
    bar.set_label("position error [m]", fontsize=12, color=look.INK)
    bar.ax.tick_params(labelsize=11, colors=look.INK)
    return figure


def _rows(T_world_base: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x, y, z [m] and yaw [deg] of (N, 4, 4) poses, as (4, N)."""
    yaw_deg = np.degrees(np.arctan2(T_world_base[:, 1, 0], T_world_base[:, 0, 0]))
    return np.vstack([T_world_base[:, :3, 3].T, yaw_deg])


def _cut(values: NDArray[np.float64], row: int) -> NDArray[np.float64]:
    """Return a heading with NaN where it leaps from 180 to -180 degrees, else what was given."""
    if row < 3 or len(values) < 2:
        return values
    leaps = np.append(False, np.abs(np.diff(values)) > _TURN_DEG)
    return np.where(leaps, np.nan, values)


def _within(true: Trajectory, estimated: Trajectory) -> NDArray[np.bool_]:
    first_ns, last_ns = estimated.stamps_ns[0], estimated.stamps_ns[-1]
    return np.asarray((true.stamps_ns >= first_ns) & (true.stamps_ns <= last_ns))
