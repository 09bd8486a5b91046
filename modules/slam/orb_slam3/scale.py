"""How many metres a unit of a monocular map is: odometry measures the same motion."""

from __future__ import annotations

import numpy as np

from .anchor import Transform, inverse

_BASELINE_M = 0.5  # of odometry, which is off by some per cent, and a map's first metre by less
_ALIKE_MIN = 0.9  # cosine between both paths; with less the map is not one of this motion


class Scale:
    """Compares the camera's path in one map with the path by odometry."""

    def __init__(self) -> None:
        self._T_world_first: Transform | None = None
        self._T_odom_first: Transform = np.eye(4)
        self._sums = np.zeros(3)  # of the paths' products: both, the map's alone, odometry's alone
        self._length_m = 0.0

    def add(self, T_world_cam: Transform, T_odom_cam: Transform) -> None:
        """Take where the camera is in the map and by odometry."""
        if self._T_world_first is None:
            self._T_world_first, self._T_odom_first = T_world_cam, T_odom_cam
        unscaled = (inverse(self._T_world_first) @ T_world_cam)[:3, 3]
        moved_m = (inverse(self._T_odom_first) @ T_odom_cam)[:3, 3]
        self._sums += unscaled @ moved_m, unscaled @ unscaled, moved_m @ moved_m
        self._length_m = max(self._length_m, float(np.linalg.norm(moved_m)))

    @property
    def metres(self) -> float | None:
        """Return the metres per unit, None while the paths are too short or unlike."""
        both, unscaled, measured = self._sums
        if self._length_m < _BASELINE_M or both < _ALIKE_MIN * np.sqrt(unscaled * measured):
            return None
        return float(both / unscaled) if unscaled > 0 else None
