"""Keyframe scans: the latest for scan matching, all for the map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Planar, wrap
from sceneslam.types.se3 import Transform

from .free_space import FreeSpace
from .surface import SurfacePoints, joined


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanKeyframe:
    """A scan that is part of the map."""

    T_local_base: Planar
    scan: LaserScan


@dataclass(slots=True)
class ScanKeyframes:
    """All keyframes of one activation, in the order they were taken.

    A submap is `submap_keyframes` consecutive keyframes. Scans are matched with the latest two
    submaps, of which the last is being built, as in Cartographer (Hess et al., "Real-time loop
    closure in 2D LIDAR SLAM", ICRA 2016).
    """

    keyframe_distance_m: float
    keyframe_angle_rad: float
    submap_keyframes: int
    reach_m: float  # farther keyframes do not see the same
    frames: list[ScanKeyframe] = field(default_factory=list)
    _surfaces: list[SurfacePoints] = field(default_factory=list, init=False)  # local, of the latest

    def is_due(self, T_local_base: Planar) -> bool:
        """Tell whether the robot has moved far enough from the last keyframe."""
        if not self.frames:
            return True
        last = self.frames[-1].T_local_base
        moved_m = float(np.hypot(*(T_local_base[:2] - last[:2])))
        turned_rad = abs(wrap(T_local_base[2] - last[2]))
        return moved_m > self.keyframe_distance_m or turned_rad > self.keyframe_angle_rad

    def add(self, frame: ScanKeyframe, surfaces_base: SurfacePoints) -> None:
        """Append a keyframe with its scan's surfaces, in its base."""
        if len(self.frames) % self.submap_keyframes == 0:
            del self._surfaces[: -self.submap_keyframes]
        self.frames.append(frame)
        self._surfaces.append(surfaces_base.moved(frame.T_local_base))

    def clear(self) -> None:
        """Remove all keyframes."""
        self.frames.clear()
        self._surfaces.clear()

    def free(self, T_base_laser: Transform, range_max_m: float) -> FreeSpace:
        """Return the free space of the latest two submaps."""
        recent = self.frames[-len(self._surfaces) :]
        return FreeSpace(
            [frame.scan for frame in recent],
            [frame.T_local_base for frame in recent],
            T_base_laser,
            range_max_m,
        )

    def latest(self) -> SurfacePoints:
        """Return the surfaces of the latest two submaps that the newest keyframe may see, local.

        The others are left out, so that a jump of the pose does not make the field too large.
        """
        recent = self.frames[-len(self._surfaces) :]
        here = recent[-1].T_local_base[:2]
        return joined(
            [
                surfaces
                for frame, surfaces in zip(recent, self._surfaces, strict=True)
                if np.hypot(*(frame.T_local_base[:2] - here)) <= self.reach_m
            ]
        )
