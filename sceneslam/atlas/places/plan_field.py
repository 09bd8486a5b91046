"""Look-up tables of a floor plan: the nearest wall and free space at any point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import CELL_M, FloorPlan

_MARGIN = 20  # cells around the plan; points farther out have no wall near
_CLEAR_M = 0.2  # least distance to walls of free cells that count as evidence of no wall
_LIKELIHOOD_M = 0.1  # standard deviation of a wall in the coarse search


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearestWalls:
    """The walls and free space of a plan around N points."""

    error: NDArray[np.float64]  # (N, 2) [m]: from the nearest wall point to the point
    normals: NDArray[np.float64]  # (N, 2)
    distance_m: NDArray[np.float64]  # (N,)
    is_clear: NDArray[np.bool_]  # (N,): free, and no wall near
    is_known: NDArray[np.bool_]  # (N,): free, or a wall near


class PlanField:
    """The look-up tables of one plan, which must contain a wall."""

    def __init__(self, plan: FloorPlan) -> None:
        self.plan = plan
        self._free = np.pad(plan.free, _MARGIN)
        # (2,), the outer corner of the likelihood's cell (0, 0)
        self.origin_xy_m = np.array(plan.origin_xy_m) - _MARGIN * CELL_M
        image = np.ones(self._free.shape, np.uint8)
        cells = self._cells(plan.points)
        image[cells[:, 1], cells[:, 0]] = 0
        far, labels = cv2.distanceTransformWithLabels(
            image, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        owner = np.zeros(int(labels.max()) + 1, np.int64)
        owner[labels[cells[:, 1], cells[:, 0]]] = np.arange(len(plan.points))
        self._nearest, self._far_m = owner[labels], far * CELL_M
        self._points = plan.points.astype(np.float64)
        self._normals = plan.normals.astype(np.float64)

    def nearest(self, points: NDArray[np.float64]) -> NearestWalls:
        """Return walls and free space around points (N, 2) [m] of the plan's frame."""
        rows, columns = self._free.shape
        cells = self._cells(points)
        inside = ((cells >= 0) & (cells < [columns, rows])).all(axis=1)
        column, row = np.clip(cells[:, 0], 0, columns - 1), np.clip(cells[:, 1], 0, rows - 1)
        index = self._nearest[row, column]
        error = points - self._points[index]
        distance_m = np.linalg.norm(error, axis=1)
        is_free = self._free[row, column] & inside
        return NearestWalls(
            error=error,
            normals=self._normals[index],
            distance_m=distance_m,
            is_clear=is_free & (distance_m > _CLEAR_M),
            is_known=is_free | (distance_m <= _CLEAR_M),
        )

    @cached_property
    def likelihood(self) -> NDArray[np.float32]:
        """Return an image (rows, columns): 1 on a wall, less with distance, below 0 in free space.

        It includes the margin; `origin_xy_m` is its corner.
        """
        near = np.exp(-0.5 * (self._far_m / _LIKELIHOOD_M) ** 2)
        clear = self._free & (self._far_m > _CLEAR_M)
        return np.where(clear, -1.0, near).astype(np.float32)

    def _cells(self, points: NDArray[np.floating]) -> NDArray[np.int64]:
        return np.asarray(np.floor((points - self.origin_xy_m) / CELL_M).astype(np.int64))
