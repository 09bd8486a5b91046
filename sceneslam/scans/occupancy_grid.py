"""An occupancy grid in log odds whose size grows with the measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.grid_frames import in_frame
from sceneslam.types.maps import GridLayer, ScanLayer
from sceneslam.types.observation import LaserScan

_LIMIT = 3.5  # largest log odds; limited so that changes are learned within some scans
_STEP = _LIMIT / 127  # log odds per unit of the int8 cells
_HIT, _MISS = round(0.85 / _STEP), round(0.4 / _STEP)  # per measurement
_GROWTH_CELLS = 128  # rows and columns are added in blocks, since each growth copies the grid
_CLEAR_MAX_M = 3.0  # that a beam without a return is taken to be free
_SHIFT = 4  # cv2 polygons with sub-cell corners, in 1/16 cells


def signed_ranges(scan: LaserScan, range_max_m: float = np.inf) -> NDArray[np.float32]:
    """Return a scan's ranges (B,), signed as in `ScanLayer`; farther returns than a limit are none.

    A beam without a return (inf) is free for a few metres only: black surfaces, glass and walls at
    grazing angles give none either.
    """
    ranges = scan.ranges_m
    farthest_m = min(scan.range_max_m, range_max_m)
    hit = np.isfinite(ranges) & (ranges >= scan.range_min_m) & (ranges <= farthest_m)
    is_free = np.isposinf(ranges) | (np.isfinite(ranges) & (ranges > range_max_m))
    clear = np.where(is_free, -np.float32(min(_CLEAR_MAX_M, farthest_m)), np.float32(0.0))
    return np.where(hit, ranges, clear).astype(np.float32)


def scan_layer(
    scans: Sequence[LaserScan],
    T_local_laser: Sequence[se3.Transform],
    *,
    cell_m: float,
    range_max_m: float = np.inf,
) -> ScanLayer:
    """Return scans at poses T_local_laser (4, 4) as a layer; farther returns are left out."""
    ranges = [signed_ranges(scan, range_max_m) for scan in scans]
    padded = np.zeros((len(scans), max(map(len, ranges), default=0)), np.float32)
    for row, each in zip(padded, ranges, strict=True):
        row[: len(each)] = each
    return ScanLayer(
        stamps_ns=np.array([scan.stamp_ns for scan in scans], np.int64),
        T_world_laser=np.array(T_local_laser).reshape(-1, 4, 4),
        ranges_m=padded,
        angle_min_rad=np.array([scan.angle_min_rad for scan in scans], np.float64),
        angle_step_rad=np.array([scan.angle_step_rad for scan in scans], np.float64),
        cell_m=cell_m,
    )


def drawn(scans: ScanLayer, T_map_laser: NDArray[np.float64]) -> GridLayer:
    """Return the grid of scans at poses T_map_laser (K, 4, 4), in `map`."""
    grid = OccupancyGrid(scans.cell_m)
    beams = zip(scans.ranges_m, _angles_rad(scans), scans.angle_step_rad.tolist(), strict=True)
    for T, seen in zip(T_map_laser, beams, strict=True):
        grid.add(T, *seen)
    return grid.layer()


def walls(scans: ScanLayer, T_map_laser: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the ends (N, 3) [m], map, of beams with a return, at T_map_laser (K, 4, 4).

    Of those of one scan that lie in one cell, the first.
    """
    found = [np.zeros((0, 3), np.float32)]
    for T, ranges_m, angles in zip(T_map_laser, scans.ranges_m, _angles_rad(scans), strict=True):
        hit = ranges_m > 0.0
        reach_m = ranges_m[hit].astype(np.float64)
        x, y = reach_m * np.cos(angles[hit]), reach_m * np.sin(angles[hit])
        ends = se3.apply(T, np.column_stack([x, y, np.zeros_like(x)]))
        cells = np.floor(ends / scans.cell_m).astype(np.int64)
        _, first = np.unique(cells, axis=0, return_index=True)
        found.append(ends[np.sort(first)].astype(np.float32))
    return np.concatenate(found)


def _angles_rad(scans: ScanLayer) -> Iterator[NDArray[np.float64]]:
    """Yield the angles (B,) of each scan's beams."""
    beams = np.arange(scans.ranges_m.shape[1])
    for least, step in zip(scans.angle_min_rad, scans.angle_step_rad, strict=True):
        yield least + step * beams


class OccupancyGrid:
    """Log odds of cells: hits at the ends of beams, misses along them."""

    def __init__(self, resolution_m: float, *, cells_max: int = 64_000_000) -> None:
        """Make an empty grid.

        It never has more than `cells_max` cells; measurements outside are left out.
        """
        if not resolution_m > 0:
            raise ConfigError("resolution_m", resolution_m, "above 0")
        if cells_max < _GROWTH_CELLS**2:
            raise ConfigError("cells_max", cells_max, f"{_GROWTH_CELLS**2} or more")
        self.resolution_m = resolution_m
        self._cells_max = cells_max
        self._cells = np.zeros((0, 0), dtype=np.int8)  # log odds in steps
        self._origin = np.zeros(2, dtype=np.int64)  # cell (column, row) of the array's corner

    @classmethod
    def of(cls, layer: GridLayer, resolution_m: float) -> OccupancyGrid:
        """Return a grid that goes on from a layer, with cells of its own size."""
        grid, layer = cls(resolution_m), in_frame(se3.identity(), layer, cell_m=resolution_m)
        grid._cells = np.clip(np.rint(layer.log_odds / _STEP), -127, 127).astype(np.int8)
        grid._origin = np.rint(np.array(layer.origin_xy_m) / resolution_m).astype(np.int64)
        return grid

    def insert(self, T_local_laser: se3.Transform, scan: LaserScan) -> None:
        """Add a scan at T_local_laser (4, 4) [m], projected to the xy plane."""
        self.add(T_local_laser, signed_ranges(scan), scan.angles_rad, scan.angle_step_rad)

    def add(
        self,
        T_local_laser: se3.Transform,
        ranges_m: NDArray[np.float32],
        angles_rad: NDArray[np.floating],
        angle_step_rad: float,
    ) -> None:
        """Add ranges (B,), signed as in `ScanLayer`, at angles (B,)."""
        ranges, angles = ranges_m.astype(np.float64), angles_rad.astype(np.float64)
        hit = ranges > 0.0
        free_to = np.where(hit, np.maximum(ranges - 0.5 * self.resolution_m, 0.0), -ranges)
        half = 0.5 * angle_step_rad
        # One star-shaped polygon is the free space of all beams: each beam is a wedge.
        corners = _ends(
            T_local_laser,
            np.column_stack([angles - half, angles + half]).ravel(),
            np.repeat(free_to, 2),
        )
        origin_xy = T_local_laser[:2, 3]
        hits_xy = _ends(T_local_laser, angles[hit], ranges[hit])
        seen = np.vstack([corners, hits_xy, origin_xy[None]])
        self._grow(seen)
        if self._cells.size == 0:
            return
        self._add(np.vstack([corners, origin_xy[None]]), hits_xy)

    def layer(self) -> GridLayer:
        """Return a copy of the grid in `local`."""
        x_m, y_m = (self._origin * self.resolution_m).tolist()
        log_odds = np.maximum(self._cells, -127) * np.float32(_STEP)
        log_odds.flags.writeable = False
        return GridLayer(log_odds=log_odds, resolution_m=self.resolution_m, origin_xy_m=(x_m, y_m))

    def _add(self, free_xy: NDArray[np.float64], hits_xy: NDArray[np.float64]) -> None:
        rows, columns = self._cells.shape
        polygon = free_xy / self.resolution_m - self._origin - 0.5  # cell centres at integers
        lowest = np.clip(np.floor(polygon.min(axis=0)), 0, (columns - 1, rows - 1)).astype(int)
        highest = np.clip(np.ceil(polygon.max(axis=0)), 0, (columns - 1, rows - 1)).astype(int)
        width, height = highest - lowest + 1
        free = np.zeros((height, width), dtype=np.int8)
        corners = np.round((polygon - lowest) * 2**_SHIFT).astype(np.int32)
        cv2.fillPoly(free, [corners], _MISS, lineType=cv2.LINE_8, shift=_SHIFT)
        cells = np.floor(hits_xy / self.resolution_m).astype(np.int64) - self._origin
        cells = cells[np.all((cells >= 0) & (cells < (columns, rows)), axis=1)]
        was = self._cells[cells[:, 1], cells[:, 0]].astype(np.int16)
        window = self._cells[lowest[1] : lowest[1] + height, lowest[0] : lowest[0] + width]
        cv2.subtract(window, free, dst=window)
        # A cell that was hit is not free, and each scan counts once per cell.
        self._cells[cells[:, 1], cells[:, 0]] = np.minimum(was + _HIT, 127)

    def _grow(self, seen_xy: NDArray[np.float64]) -> None:
        cells = np.floor(seen_xy / self.resolution_m)
        lowest = (np.floor((cells.min(axis=0) - 1) / _GROWTH_CELLS) * _GROWTH_CELLS).astype(int)
        end = (np.ceil((cells.max(axis=0) + 2) / _GROWTH_CELLS) * _GROWTH_CELLS).astype(int)
        rows, columns = self._cells.shape
        if self._cells.size:
            lowest = np.minimum(lowest, self._origin)
            end = np.maximum(end, self._origin + np.array([columns, rows]))
        size = end - lowest
        unchanged = self._cells.size and tuple(size) == (columns, rows)
        if unchanged or int(size[0]) * int(size[1]) > self._cells_max:
            return
        grown = np.zeros((size[1], size[0]), dtype=np.int8)
        if self._cells.size:
            column, row = self._origin - lowest
            grown[row : row + rows, column : column + columns] = self._cells
        self._cells, self._origin = grown, lowest


def _ends(
    T_local_laser: se3.Transform, angles_rad: NDArray[np.float64], ranges_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the end points (N, 2) [m] of beams in the xy plane of `local`."""
    x = ranges_m * np.cos(angles_rad)
    y = ranges_m * np.sin(angles_rad)
    return np.asarray(np.column_stack([x, y]) @ T_local_laser[:2, :2].T + T_local_laser[:2, 3])
