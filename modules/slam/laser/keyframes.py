"""The scans that are kept: what is matched with now, and what the map is made of later."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan

from .planar import Matrix, Planar, wrap
from .surface import SurfacePoints, joined


@dataclass(slots=True, kw_only=True, eq=False)
class Keyframe:
    """A scan that is part of the map; its pose may be corrected."""

    stamp_ns: int
    T_local_base: Planar
    T_prev_curr: Planar  # from the keyframe before, as measured
    covariance: Matrix  # of T_prev_curr, axes of curr
    distance_m: float  # driven from the keyframe before
    scan: LaserScan
    surfaces_base: SurfacePoints


@dataclass(slots=True)
class Keyframes:
    """All keyframes of one activation, in the order they were taken.

    A submap is `submap_keyframes` of them in a row. Scans are matched with the latest two
    submaps, the last being built, as in Cartographer (Hess et al., "Real-time loop closure in 2D
    LIDAR SLAM", ICRA 2016).
    """

    keyframe_distance_m: float
    keyframe_angle_rad: float
    submap_keyframes: int
    frames: list[Keyframe] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.frames)

    def is_due(self, T_local_base: Planar) -> bool:
        """Tell whether the robot has moved far enough from the last keyframe."""
        if not self.frames:
            return True
        last = self.frames[-1].T_local_base
        moved_m = float(np.hypot(*(T_local_base[:2] - last[:2])))
        turned_rad = abs(wrap(T_local_base[2] - last[2]))
        return moved_m > self.keyframe_distance_m or turned_rad > self.keyframe_angle_rad

    @property
    def latest(self) -> range:
        """Return the numbers of the keyframes in the latest two submaps."""
        begun = (len(self.frames) - 1) // self.submap_keyframes
        return range(max(begun - 1, 0) * self.submap_keyframes, len(self.frames))

    @property
    def finished_submaps(self) -> int:
        """Return how many submaps are no longer matched with."""
        return self.latest.start // self.submap_keyframes

    def of_submap(self, submap: int) -> range:
        """Return the numbers of a submap's keyframes."""
        start = submap * self.submap_keyframes
        return range(start, min(start + self.submap_keyframes, len(self.frames)))

    def surfaces(self, numbers: range) -> SurfacePoints:
        """Return the surfaces (local) that these keyframes saw."""
        return joined(
            [self.frames[i].surfaces_base.moved(self.frames[i].T_local_base) for i in numbers]
        )

    @property
    def poses(self) -> NDArray[np.float64]:
        """Return T_local_base (N, 3) of all."""
        return np.array([frame.T_local_base for frame in self.frames]).reshape(-1, 3)
