"""A growing cloud with one point per voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_WAITING_MIN = 100_000  # points; thinned when there are as many new points as kept ones, or so many


class VoxelCloud:
    """Keeps the first point of each voxel; its memory grows with the space that it covers."""

    def __init__(self, voxel_m: float) -> None:
        self._voxel_m = voxel_m
        self._kept = np.zeros((0, 3), np.float32)
        self._waiting: list[NDArray[np.float32]] = []  # not thinned yet

    def add(self, points: NDArray[np.floating]) -> None:
        """Add points (N, 3) [m]."""
        self._waiting.append(points.astype(np.float32))
        if sum(map(len, self._waiting)) > max(len(self._kept), _WAITING_MIN):
            self.points()

    def points(self) -> NDArray[np.float32]:
        """Return the points (N, 3) [m], in the order in which they were added."""
        if self._waiting:
            points = np.concatenate([self._kept, *self._waiting])
            voxels = np.floor(points / self._voxel_m).astype(np.int64)
            first = np.unique(voxels, axis=0, return_index=True)[1]
            self._kept, self._waiting = points[np.sort(first)], []
        return self._kept
