"""Scale of a monocular map, estimated by odometry."""

from __future__ import annotations

import numpy as np

from sceneslam.types.se3 import Transform, inverse

_BASELINE_M = 0.5  # smallest path by odometry for an estimate
_ALIKE_MIN = 0.9  # smallest cosine between both paths; below, the map is wrong


class Scale:
    """Compares the camera's path in the map with that by odometry."""

    def __init__(self) -> None:
        self._T_world_first: Transform | None = None
        self._T_odom_first: Transform = np.eye(4)
        self._sums = np.zeros(3)  # of products: both paths, map's, odometry's
        self._length_m = 0.0

    def add(self, T_world_cam: Transform, T_odom_cam: Transform) -> None:
        """Add the camera's poses (4, 4) in the map and by odometry [m]."""
        if self._T_world_first is None:
            self._T_world_first, self._T_odom_first = T_world_cam, T_odom_cam
        unscaled = (inverse(self._T_world_first) @ T_world_cam)[:3, 3]
        moved_m = (inverse(self._T_odom_first) @ T_odom_cam)[:3, 3]
        self._sums += unscaled @ moved_m, unscaled @ unscaled, moved_m @ moved_m
        self._length_m = max(self._length_m, float(np.linalg.norm(moved_m)))

    @property
    def metres(self) -> float | None:
        """Return the metres per unit, None if the paths are too short or too different."""
        both, unscaled, measured = self._sums
        if self._length_m < _BASELINE_M or both < _ALIKE_MIN * np.sqrt(unscaled * measured):
            return None
        return float(both / unscaled) if unscaled > 0 else None
