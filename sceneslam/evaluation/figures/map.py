"""The hybrid map from above with the trajectory, a colour per module (the paper's Fig. 7)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.figures import style as look
from sceneslam.evaluation.switches import find_seam, is_switch
from sceneslam.types import se3
from sceneslam.types.maps import GridLayer, HybridMap
from sceneslam.types.run import RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import GroundTruth

_CELLS = 420  # along the longer side of the drawn area
_SMALL = 0.3  # of the map's extent: a smaller path is drawn separately
_UNKNOWN, _OCCUPIED = 0.55, 0.4  # greys that are visible on white and on black


def draw_map(result: RunResult, truth: GroundTruth | None, T_map_gt: Transform | None) -> Any:
    """Return the map from above; None when there is neither a map nor a pose.

    The points' density is drawn, so that walls stand out from the floor and any number of points
    costs the same. `T_map_gt` (4, 4) places the ground truth, which is not drawn without it.
    """
    bounds = _bounds(result)
    return None if bounds is None else _draw(result, truth, T_map_gt, bounds)


def draw_path(result: RunResult, truth: GroundTruth | None, T_map_gt: Transform | None) -> Any:
    """Return the part of the map around the path; None if it is not much smaller.

    A hand-held camera that turns sees a whole room but moves by centimetres.
    """
    whole, path = _bounds(result), result.trajectory.positions_m[:, :2]
    if whole is None or len(path) < 2:
        return None
    low, high = path.min(axis=0), path.max(axis=0)
    extent_m = float((high - low).max())
    if not 0.0 < extent_m < _SMALL * float((whole[1] - whole[0]).max()):
        return None
    half_m = 0.6 * extent_m  # a square, with a margin of a tenth
    middle = 0.5 * (low + high)
    return _draw(result, truth, T_map_gt, np.stack([middle - half_m, middle + half_m]))


def _draw(
    result: RunResult,
    truth: GroundTruth | None,
    T_map_gt: Transform | None,
    bounds: NDArray[np.float64],
) -> Any:
    low, high = bounds
    ratio = float(np.clip((high - low)[1] / (high - low)[0], 0.45, 1.3))
    figure = look.new_figure(look.WIDTH_IN, look.WIDTH_IN * ratio + 0.9)
    axes = figure.add_subplot()
    colors = look.module_colors(result)
    if result.map.grid is not None:
        _draw_grid(axes, result.map.grid)
    _draw_points(axes, result.map, colors, low, high)
    if truth is not None and T_map_gt is not None and len(truth.trajectory):
        true_m = se3.apply(T_map_gt, truth.trajectory.positions_m)
        axes.plot(
            true_m[:, 0],
            true_m[:, 1],
            color=look.INK,
            linewidth=0.9,
            dashes=(4, 4),
            label="ground truth",
            zorder=5,
        )
    _draw_trajectory(axes, result, colors)
    look.style(axes, x_label="x [m]", y_label="y [m]")
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    figure.legend(loc="outside lower center", ncols=3, fontsize=11, frameon=False)
    return figure


def _bounds(result: RunResult) -> NDArray[np.float64] | None:
    """Return the lower and upper corner (2, 2) [m] of what is drawn, a margin included."""
    corners = []
    if len(result.trajectory):
        path = result.trajectory.positions_m[:, :2]
        corners += [path.min(axis=0), path.max(axis=0)]
    points = result.map.points.points
    if len(points):
        # A few stray points must not shrink the rest to a dot.
        sample = points[:: max(1, len(points) // 100_000), :2].astype(float)
        corners += list(np.percentile(sample, [0.5, 99.5], axis=0))
    grid = result.map.grid
    if grid is not None and np.any(grid.log_odds):
        rows, columns = np.nonzero(grid.log_odds)
        for pick in (np.min, np.max):
            cell = np.array([pick(columns), pick(rows)])
            corners.append(np.array(grid.origin_xy_m) + (cell + 0.5) * grid.resolution_m)
    if not corners:
        return None
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = 0.04 * float((high - low).max()) + 0.2
    return np.stack([low - margin, high + margin])


def _draw_grid(axes: Any, grid: GridLayer) -> None:
    """Draw occupied cells in grey and unknown cells faintly, visible on light and dark."""
    occupied = np.maximum(np.tanh(grid.log_odds.astype(float) / 2.0), 0.0)  # 2 p - 1
    alpha = np.where(grid.log_odds == 0, 0.22, np.round(occupied, 1))
    shade = np.where(grid.log_odds == 0, _UNKNOWN, _OCCUPIED)
    rows, columns = alpha.shape
    x_m, y_m = grid.origin_xy_m
    axes.imshow(
        np.dstack([shade, shade, shade, alpha]),
        origin="lower",
        interpolation="nearest",
        zorder=1,
        extent=(x_m, x_m + columns * grid.resolution_m, y_m, y_m + rows * grid.resolution_m),
    )


def _draw_points(
    axes: Any,
    hybrid: HybridMap,
    colors: dict[str, str],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> None:
    from matplotlib.colors import to_rgb

    step_m = float((high - low).max()) / _CELLS
    columns, rows = np.maximum(np.ceil((high - low) / step_m).astype(int), 1)
    for number, key in enumerate(hybrid.modules):
        points = hybrid.points.points[hybrid.point_modules == number, :2]
        cells = np.floor((points - low) / step_m).astype(int)
        inside = np.all((cells >= 0) & (cells < [columns, rows]), axis=1)
        flat = cells[inside, 1] * columns + cells[inside, 0]
        count = np.bincount(flat, minlength=rows * columns).reshape(rows, columns)
        if not count.any():
            continue
        full = float(np.percentile(count[count > 0], 98))
        # The root leaves walls (many points above each other) strong and the floor faint. Steps of
        # a tenth: the eye sees no more, and the file is half as large.
        alpha = np.round(np.sqrt(np.minimum(count / full, 1.0)), 1) * 0.75
        image = np.dstack([np.broadcast_to(to_rgb(colors[key]), (rows, columns, 3)), alpha])
        extent = (low[0], low[0] + columns * step_m, low[1], low[1] + rows * step_m)
        axes.imshow(image, origin="lower", extent=extent, interpolation="nearest", zorder=2)


def _draw_trajectory(axes: Any, result: RunResult, colors: dict[str, str]) -> None:
    from matplotlib.patheffects import Normal, Stroke

    path = result.trajectory.positions_m
    modules = np.array(result.modules, dtype=object)
    casing = [Stroke(linewidth=3.8, foreground=look.PAPER), Normal()]
    for key in dict.fromkeys(result.modules):
        # A step belongs to the module that gave the pose it leads to.
        mine = modules == key
        shown = mine | np.append(mine[1:], False)
        line = np.where(shown[:, None], path[:, :2], np.nan)
        style = ":" if key == "" else "-"
        axes.plot(
            line[:, 0],
            line[:, 1],
            style,
            color=colors.get(key, look.BRIDGED),
            linewidth=2.0,
            label=key or "bridged",
            path_effects=casing,
            zorder=4,
        )
    if len(path):
        axes.plot(*path[0, :2], "o", color=look.INK, markersize=6, label="start", zorder=6)
        axes.plot(*path[-1, :2], "s", color=look.INK, markersize=6, label="end", zorder=6)
    seams = [find_seam(result, event) for event in result.events if is_switch(event)]
    at = path[[seam.after for seam in seams if seam is not None]]
    if len(at):
        axes.plot(
            at[:, 0],
            at[:, 1],
            "D",
            markersize=7,
            markerfacecolor=look.PAPER,
            markeredgecolor=look.INK,
            markeredgewidth=1.6,
            label="switch",
            zorder=7,
        )
