"""The likelihood field for scan matching: mean surface points per cell, and the nearest ones."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .free_space import FreeSpace
from .surface import SurfacePoints

_REACH_M = 0.3  # the likelihood falls to 0 at this distance from a surface
_SAME_M = 0.15  # from a surface: on it
_MARGIN_CELLS = 8
_AROUND_CELLS = 2  # neighbourhood that shows whether a surface continues or ends
_POST = 1.1  # trace of the shape: 1 for a line; above, it also constrains along itself
_END_RATIO = 0.4  # of a cell: a point this far from the centre of its neighbours is an end


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearestSurfaces:
    """The nearest surface to each of N points, component by component: axes of two are slow."""

    points: NDArray[np.float64]  # (2, N) [m], local
    shape: NDArray[np.float64]  # (3, N)
    normal_variance: NDArray[np.float64]  # (N,) [rad^2]
    outward: NDArray[np.float64]  # (2, N), out of the map: unit vector at a surface's end, else 0


class LikelihoodField:
    """Surfaces around the robot, in `local`, with look-ups in constant time."""

    def __init__(
        self, surfaces: SurfacePoints, resolution_m: float, free: FreeSpace | None = None
    ) -> None:
        """Build the field of a local map with at least one point; `free`: None if unknown."""
        self.resolution_m, self._free = resolution_m, free
        cells = np.floor(surfaces.points / resolution_m).astype(np.int64)
        self._origin = cells.min(axis=0) - _MARGIN_CELLS
        columns, rows = (cells.max(axis=0) - self._origin + 1 + _MARGIN_CELLS).tolist()
        self._limit = np.array([columns - 1, rows - 1])
        flat = (cells[:, 1] - self._origin[1]) * columns + cells[:, 0] - self._origin[0]
        occupied, index = np.unique(flat, return_inverse=True)
        averages = _averages(surfaces, index, len(occupied))
        image = np.full((rows, columns), 255, dtype=np.uint8)
        image.reshape(-1)[occupied] = 0
        distance_px, labels = cv2.distanceTransformWithLabels(
            image, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        surface_of_label = np.zeros(len(occupied) + 1, dtype=np.int64)
        surface_of_label[labels.reshape(-1)[occupied]] = np.arange(len(occupied))
        self._nearest = surface_of_label[labels]
        outward = self._out_of_map(image, occupied, averages[:2].T, averages[2:5])
        self._surfaces = np.concatenate([averages, outward.T])
        self._likelihood = np.maximum(
            np.float32(1.0) - distance_px * np.float32(resolution_m / _REACH_M), np.float32(0.0)
        )

    def is_free(self, points_local: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell which of the points (N, 2) [m] lie in space that was seen to be free."""
        if self._free is None:
            return np.ones(len(points_local), bool)
        return self._free.contains(points_local)

    def refuted_ratio(self, points_local: NDArray[np.float64]) -> float:
        """Return the share of points (N, 2) [m] in free space, of those and those on surfaces."""
        away_m = np.linalg.norm(points_local - self.nearest(points_local.T).points.T, axis=1)
        same = int((away_m < _SAME_M).sum())
        free = int(self.is_free(points_local[away_m >= _SAME_M]).sum())
        return free / max(free + same, 1)

    def nearest(self, points_local: NDArray[np.float64]) -> NearestSurfaces:
        """Return the nearest surfaces of points (2, N) [m]."""
        column, row = self._cells(points_local)
        found = self._surfaces.take(self._nearest[row, column], axis=1)
        return NearestSurfaces(
            points=found[:2], shape=found[2:5], normal_variance=found[5], outward=found[6:]
        )

    def likelihood(
        self, points_local: NDArray[np.float64], offsets_m: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return likelihoods (A, K), 0 to 1, of points (A, N, 2) [m] moved by offsets (K, 2)."""
        shift = np.round(offsets_m / self.resolution_m).astype(np.int64)
        reach = int(np.abs(shift).max(initial=0))
        grid = np.pad(self._likelihood, 2 * reach)  # 0 as at the border: points may lie outside
        start = np.floor(points_local / self.resolution_m).astype(np.int64) - self._origin
        start = np.minimum(np.maximum(start, -reach), self._limit + reach) + 2 * reach
        across = np.array([1, grid.shape[1]])
        index = (start @ across)[:, None, :] + (shift @ across)[None, :, None]
        return np.asarray(grid.take(index).mean(axis=-1))

    def pooled(self, factor: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return the best likelihood (rows, columns) per `factor`^2 cells, and its corner."""
        before = self._origin % factor
        rows, columns = self._likelihood.shape
        behind = -(before + np.array([columns, rows])) % factor
        grid = np.pad(
            self._likelihood, ((int(before[1]), int(behind[1])), (int(before[0]), int(behind[0])))
        )
        blocks = grid.reshape(grid.shape[0] // factor, factor, grid.shape[1] // factor, factor)
        return np.ascontiguousarray(blocks.max(axis=(1, 3))), self._origin // factor

    @property
    def points(self) -> NDArray[np.float64]:
        """Return the mean surface points (N, 2) [m] of all cells that have one."""
        return self._surfaces[:2].T

    def _out_of_map(
        self,
        image: NDArray[np.uint8],
        occupied: NDArray[np.int64],
        points: NDArray[np.float64],
        shape: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return per surface the direction (M, 2) in which the map ends, 0 for a line."""
        is_post = shape[0] + shape[2] >= _POST
        steps = np.arange(-_AROUND_CELLS, _AROUND_CELLS + 1)
        around = occupied[is_post, None] + (steps[:, None] * image.shape[1] + steps).reshape(-1)
        is_mapped = image.reshape(-1)[around] == 0
        surface = self._nearest.reshape(-1)[around]
        total = np.where(is_mapped[..., None], points[surface], 0.0).sum(axis=1)
        out = points[is_post] - total / is_mapped.sum(axis=1)[:, None]
        away_m = np.linalg.norm(out, axis=1, keepdims=True)
        outward = np.zeros_like(points)
        outward[is_post] = out / np.maximum(away_m, _END_RATIO * self.resolution_m)
        return outward

    def _cells(self, points_local: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the column and row (2, N) of points (2, N), or of the border next to them."""
        cells = np.floor(points_local / self.resolution_m).astype(np.int64) - self._origin[:, None]
        return np.asarray(np.minimum(np.maximum(cells, 0), self._limit[:, None]))


def _averages(surfaces: SurfacePoints, index: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Return x, y, the shape, and the normal's variance (6, M) of surfaces per cell, as (N,) index.

    Each is weighted.
    """
    weight = surfaces.weight
    total = np.bincount(index, weights=weight, minlength=count)
    means = [
        np.bincount(index, weights=weight * values, minlength=count) / total
        for values in (*surfaces.points.T, *surfaces.shape.T)
    ]
    known = np.bincount(index, weights=1.0 / surfaces.normal_variance, minlength=count)
    return np.array([*means, 1.0 / known])
