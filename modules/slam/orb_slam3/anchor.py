"""The pose and scale of a map of ORB-SLAM3 in `local`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.se3 import Transform, inverse


class Anchor:
    """The transform of one map with unit `metres`: T_local_cam = T_local_world @ T_world_cam."""

    def __init__(self, T_local_cam: Transform, T_world_cam: Transform, metres: float = 1.0) -> None:
        self._metres = metres
        self._T_local_world = T_local_cam @ inverse(self._scaled(T_world_cam))

    def place(self, T_world_cam: Transform) -> Transform:
        """Return T_local_cam (4, 4) [m] of T_world_cam in units of the map."""
        return np.asarray(self._T_local_world @ self._scaled(T_world_cam))

    def place_points(self, points_world: NDArray[Any]) -> NDArray[np.float32]:
        """Return points (N, 3) [m], local, of points in units of the map."""
        T = self._T_local_world
        return np.asarray(self._metres * points_world @ T[:3, :3].T + T[:3, 3], np.float32)

    def _scaled(self, T_world_cam: Transform) -> Transform:
        scaled = np.array(T_world_cam, np.float64)
        scaled[:3, 3] *= self._metres
        return scaled
