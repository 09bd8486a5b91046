"""Occupancy grids in the axes of another frame."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.maps import GridLayer
from sceneslam.types.se3 import Transform


def in_frame(
    T_frame_local: Transform, grid: GridLayer, *, cell_m: float | None = None
) -> GridLayer:
    """Return a grid in the axes of `frame`: the nearest cells, and every occupied one.

    T_frame_local (4, 4) [m] counts by x, y and yaw. The grid is copied only if it has a yaw, or
    with cells of another size `cell_m`.
    """
    T, cell_m = _planar(T_frame_local), grid.resolution_m if cell_m is None else cell_m
    if np.array_equal(T[:2, :2], np.eye(2)) and cell_m == grid.resolution_m:
        x_m, y_m = (T[:2, 3] + grid.origin_xy_m).tolist()
        return replace(grid, origin_xy_m=(x_m, y_m))
    corners = grid_corners(T, grid)
    low = np.floor(corners.min(axis=0) / cell_m)
    columns, rows = (np.ceil(corners.max(axis=0) / cell_m) - low).astype(int).tolist()
    x_m, y_m = (low * cell_m).tolist()
    log_odds = resampled(T, grid, (x_m, y_m), cell_m, (columns, rows))
    # An old cell may lie between the centres of all new ones: what stands there must not vanish.
    occupied = np.argwhere(grid.log_odds > 0)[:, ::-1]
    centres = (occupied + 0.5) * grid.resolution_m + grid.origin_xy_m
    column, row = np.floor((centres @ T[:2, :2].T + T[:2, 3]) / cell_m - low).astype(int).T
    np.maximum.at(log_odds, (row, column), grid.log_odds[occupied[:, 1], occupied[:, 0]])
    return GridLayer(log_odds=log_odds, resolution_m=cell_m, origin_xy_m=(x_m, y_m))


@np.errstate(over="ignore", invalid="ignore")  # where cells have no sensible size
def grid_corners(T_frame_local: Transform, grid: GridLayer) -> NDArray[np.float64]:
    """Return the outer corners (4, 2) [m], frame, of a grid."""
    rows, columns = grid.log_odds.shape
    low = np.array(grid.origin_xy_m)
    high = low + grid.resolution_m * np.array([columns, rows])
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [*high]])
    T = _planar(T_frame_local)
    return np.asarray(corners @ T[:2, :2].T + T[:2, 3])


def resampled(
    T_frame_local: Transform,
    grid: GridLayer,
    origin_xy_m: tuple[float, float],
    resolution_m: float,
    size_wh: tuple[int, int],
) -> NDArray[np.float32]:
    """Return the log odds (rows, columns) at the centres of a frame's cells (nearest cell)."""
    T = se3.inverse(_planar(T_frame_local))
    # Cell indices of the frame -> metres in it -> metres in local -> cell indices of the grid.
    scale = resolution_m / grid.resolution_m
    centre = np.array(origin_xy_m) + resolution_m / 2
    offset = T[:2, :2] @ centre + T[:2, 3] - np.array(grid.origin_xy_m) - grid.resolution_m / 2
    affine = np.column_stack([scale * T[:2, :2], offset / grid.resolution_m])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    log_odds = grid.log_odds.astype(np.float32, copy=False)  # OpenCV knows few types
    return np.asarray(cv2.warpAffine(log_odds, affine, size_wh, flags=flags))


def _planar(T_a_b: Transform) -> Transform:
    """Return the planar part (x, y, yaw) of a transform."""
    return se3.from_xy_yaw(T_a_b[0, 3], T_a_b[1, 3], se3.yaw_rad(T_a_b))
