"""A floor plan: walls and free space, drawn from scans at known poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.key_scan import KeyScan, line_normals
from sceneslam.types import planar
from sceneslam.types.errors import InputError
from sceneslam.types.maps import GridLayer
from sceneslam.types.planar import Planar

CELL_M = 0.05  # a depth camera's error at 4 m; finer structure is not repeatable
_PAD = 10  # cells around everything
_SHORT_CELLS = 1.5  # a ray ends this far before its return, so that walls are not free
_HITS_PER_MISS = 0.25  # low, as many rays pass a wall at grazing incidence
_AGREE_RATIO = 0.8  # length of the mean normal, above which normals belong to one wall
_WALL, _FREE = 3.0, -3.0  # log odds of a grid: 0.95 and 0.05
_CELLS_MAX = 5 * 10**7  # 350 m x 350 m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorPlan:
    """Walls as points, at most one per cell, and free cells; other cells are unknown."""

    points: NDArray[np.float32]  # (P, 2) [m]
    normals: NDArray[np.float32]  # (P, 2) unit, towards the sensor; 0: no line
    free: NDArray[np.bool_]  # (rows, columns); row 0 is the lowest y
    origin_xy_m: tuple[float, float]  # outer corner of cell (0, 0), a multiple of the cell

    def __len__(self) -> int:
        return len(self.points)

    def cells(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return the (N, 2) column and row of points (N, 2), which may lie outside."""
        cells = np.floor((points - np.array(self.origin_xy_m)) / CELL_M)
        return np.asarray(cells, np.int64)

    def is_free(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Tell which points (N, 2) lie in free cells."""
        cells, (rows, columns) = self.cells(points), self.free.shape
        inside = ((cells >= 0) & (cells < [columns, rows])).all(axis=1)
        found = np.zeros(len(points), bool)
        found[inside] = self.free[cells[inside, 1], cells[inside, 0]]
        return found

    def free_points(self) -> NDArray[np.float64]:
        """Return the centres (N, 2) [m] of the free cells."""
        rows, columns = np.nonzero(self.free)
        centres = (np.column_stack([columns, rows]) + 0.5) * CELL_M + np.array(self.origin_xy_m)
        return np.asarray(centres, np.float64)


def empty() -> FloorPlan:
    """Return an empty plan."""
    nothing = np.zeros((0, 2), np.float32)
    return FloorPlan(
        points=nothing, normals=nothing, free=np.zeros((1, 1), bool), origin_xy_m=(0.0, 0.0)
    )


def draw(scans: Sequence[tuple[Planar, KeyScan]]) -> FloorPlan:
    """Return the plan of scans at poses T_plan_base."""
    if not any(len(scan.points) for _, scan in scans):
        return empty()
    ends = [planar.apply(T, scan.points.astype(np.float64)) for T, scan in scans]
    starts = [planar.apply(T, scan.origin[None])[0] for T, scan in scans]
    everything = np.concatenate([*ends, *(start[None] for start in starts)])
    low, (rows, columns) = _box(everything)
    misses, hits = (np.zeros((rows, columns), np.uint16) for _ in range(2))  # scans, not beams
    for start, end in zip(starts, ends, strict=True):
        ray = np.zeros((rows, columns), np.uint8)
        _draw_rays(ray, start / CELL_M - low, end / CELL_M - low)
        misses += ray
        hits.reshape(-1)[np.unique(_index(end, low, columns))] += 1
    points = np.concatenate(ends)
    turned = [line_normals(scan) @ planar.rotation(float(T[2])).T for T, scan in scans]
    index, count, centres, normals = _binned(points, np.concatenate(turned), low, columns)
    least = 1 if len(scans) < 3 else 2
    hit, passed = hits.reshape(-1)[index], misses.reshape(-1)[index]
    is_wall = (count >= least) & (hit >= _HITS_PER_MISS * passed)
    free = misses >= least
    free.reshape(-1)[index] = False
    return _plan(centres[is_wall], normals[is_wall], free, low)


def join(placed: Sequence[tuple[Planar, FloorPlan]], *, newest_wins: bool = False) -> FloorPlan:
    """Return one plan joined from plans at poses T_joined_plan, oldest first.

    `newest_wins`: a wall is removed if a later plan saw free space around its cell. Raises
    InputError as `check_size` does.
    """
    placed = _shown(placed)
    if not placed:
        return empty()
    points = _walls(placed)
    normals = [plan.normals @ planar.rotation(float(T[2])).T for T, plan in placed]
    low, (rows, columns) = _box(np.concatenate([*points, *(_corners(T, p) for T, p in placed)]))
    free = np.zeros((rows, columns), bool)
    newest = np.zeros((rows, columns), np.int32)  # plan that saw free space around the cell
    for number, (T, plan) in enumerate(placed):
        seen = _laid(T, plan, low, (rows, columns))
        if newest_wins:
            newest[cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = number
        free |= seen
    numbers = np.repeat(np.arange(len(points)), [len(walls) for walls in points])
    left = np.concatenate([np.concatenate(points), np.concatenate(normals)], axis=1)
    left = left[_at(newest, left[:, :2], low) <= numbers]
    index, _, centres, mean = _binned(left[:, :2], left[:, 2:], low, columns)
    free.reshape(-1)[index] = False
    return _plan(centres, mean, free, low)


def check_size(placed: Sequence[tuple[Planar, FloorPlan]]) -> None:
    """Raise InputError if a plan joined from plans at poses T_joined_plan needs too much memory."""
    placed = _shown(placed)
    if placed:
        _box(np.concatenate([*_walls(placed), *(_corners(T, plan) for T, plan in placed)]))


def grid_of(plan: FloorPlan) -> GridLayer:
    """Return a plan as an occupancy grid."""
    log_odds = np.where(plan.free, _FREE, 0.0).astype(np.float32)
    cells = plan.cells(plan.points)
    log_odds[cells[:, 1], cells[:, 0]] = _WALL
    return GridLayer(log_odds=log_odds, resolution_m=CELL_M, origin_xy_m=plan.origin_xy_m)


def _shown(placed: Sequence[tuple[Planar, FloorPlan]]) -> list[tuple[Planar, FloorPlan]]:
    """Return the plans that are not empty."""
    return [(T, plan) for T, plan in placed if len(plan) or plan.free.any()]


def _walls(placed: Sequence[tuple[Planar, FloorPlan]]) -> list[NDArray[np.float64]]:
    """Return the wall points (P, 2) of each plan at its pose."""
    return [planar.apply(T, plan.points.astype(np.float64)) for T, plan in placed]


def _plan(
    centres: NDArray[np.float64],
    normals: NDArray[np.float64],
    free: NDArray[np.bool_],
    low: NDArray[np.int64],
) -> FloorPlan:
    x_m, y_m = (low * CELL_M).tolist()
    return FloorPlan(
        points=centres.astype(np.float32),
        normals=normals.astype(np.float32),
        free=free,
        origin_xy_m=(x_m, y_m),
    )


def _box(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Return the lowest cell and the (rows, columns) of a grid around points.

    Raises InputError if it needs too much memory.
    """
    low = np.floor(points.min(axis=0) / CELL_M).astype(np.int64) - _PAD
    high = np.floor(points.max(axis=0) / CELL_M).astype(np.int64) + _PAD + 1
    columns, rows = (high - low).tolist()
    if rows * columns > _CELLS_MAX:
        size = f"{columns * CELL_M:.0f} m x {rows * CELL_M:.0f} m"
        raise InputError(f"a floor plan of {size}, allowed: {_CELLS_MAX * CELL_M**2:.0f} m2")
    return low, (rows, columns)


def _draw_rays(
    image: NDArray[np.uint8], start: NDArray[np.float64], ends: NDArray[np.float64]
) -> None:
    """Draw rays, in cells, up to just before their ends."""
    away = ends - start
    length = np.linalg.norm(away, axis=1, keepdims=True)
    ends = start + away * np.maximum(1.0 - _SHORT_CELLS / np.maximum(length, 1e-9), 0.0)
    rays = np.stack([np.broadcast_to(start, ends.shape), ends], axis=1)
    cv2.polylines(image, list(np.floor(rays).astype(np.int32)), False, 1)


def _binned(
    points: NDArray[np.float64],
    normals: NDArray[np.floating],
    low: NDArray[np.int64],
    columns: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the cells that hold points (flat indices), how many, their mean and normal (P, 2).

    The normal is 0 if those of a cell disagree.
    """
    flat = _index(points, low, columns)
    index, inverse, count = np.unique(flat, return_inverse=True, return_counts=True)
    size = len(index)
    sums = [np.bincount(inverse, points[:, axis], size) for axis in (0, 1)]
    faced = np.column_stack([np.bincount(inverse, normals[:, axis], size) for axis in (0, 1)])
    lines = np.bincount(inverse, np.abs(normals).sum(axis=1) > 0, size)
    length = np.linalg.norm(faced, axis=1)
    agrees = (length > _AGREE_RATIO * lines) & (lines > 0)
    unit = np.where(agrees[:, None], faced / np.maximum(length, 1e-9)[:, None], 0.0)
    return index, count, np.column_stack(sums) / count[:, None], unit


def _corners(T_joined_plan: Planar, plan: FloorPlan) -> NDArray[np.float64]:
    rows, columns = plan.free.shape
    unit = np.array([[0, 0], [0, rows], [columns, 0], [columns, rows]], np.float64)
    return planar.apply(T_joined_plan, np.array(plan.origin_xy_m) + CELL_M * unit)


def _laid(
    T_joined_plan: Planar, plan: FloorPlan, low: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return the free cells of a plan in the cells of another grid (nearest)."""
    turn = planar.rotation(float(T_joined_plan[2])).T
    shift = turn @ ((low + 0.5) * CELL_M - T_joined_plan[:2]) - np.array(plan.origin_xy_m)
    affine = np.column_stack([turn, shift / CELL_M - 0.5])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    size_wh = (shape[1], shape[0])
    return np.asarray(cv2.warpAffine(plan.free.astype(np.uint8), affine, size_wh, flags=flags) > 0)


def _at(image: NDArray[Any], points: NDArray[np.float64], low: NDArray[np.int64]) -> NDArray[Any]:
    return np.asarray(image.reshape(-1)[_index(points, low, image.shape[1])])


def _index(points: NDArray[np.float64], low: NDArray[np.int64], columns: int) -> NDArray[np.int64]:
    """Return the flat index (N,) of the cell of each point (N, 2) [m] in a grid from cell low."""
    cells = np.floor(points / CELL_M).astype(np.int64) - low
    return np.asarray(cells[:, 1] * columns + cells[:, 0])
