"""Which voxels around the robot a map knows: how much of a cloud lies where something was seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_SLOTS = 1 << 20


class KnownVoxels:
    """A table of hashed voxels; few of them share a place."""

    def __init__(self, voxel_m: float) -> None:
        self._voxel_m = voxel_m
        self._known = np.zeros(_SLOTS, np.bool_)

    def add(self, points_local: NDArray[Any]) -> None:
        """Note where points (N, 3) [m] lie."""
        self._known[self._slots(points_local)] = True

    def reset(self, points_local: NDArray[Any]) -> None:
        """Know these points' voxels alone."""
        self._known[:] = False
        self.add(points_local)

    def count(self, points_local: NDArray[Any]) -> int:
        """Return how many of the points lie in known voxels."""
        return int(self._known[self._slots(points_local)].sum())

    def _slots(self, points: NDArray[Any]) -> NDArray[np.int64]:
        cells = np.floor(points / self._voxel_m).astype(np.int64)
        keys = (cells[:, 0] * 73856093) ^ (cells[:, 1] * 19349669) ^ (cells[:, 2] * 83492791)
        return np.asarray(keys & (_SLOTS - 1))
