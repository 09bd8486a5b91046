"""Keyframes in submaps: what is matched with now, and what the map is made of later.

A submap is rigid: its keyframes' poses are relative to its own frame, so that a pose graph can
move whole submaps. Scans are matched with the two latest submaps, as in Cartographer (Hess et al.,
"Real-time loop closure in 2D LIDAR SLAM", ICRA 2016).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan

from .planar import Planar, between, compose, wrap
from .surface import SurfacePoints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """A scan that is part of the map."""

    T_submap_base: Planar
    scan: LaserScan
    surfaces_base: SurfacePoints


@dataclass(slots=True)
class Submap:
    """A piece of the map that is rigid in itself."""

    T_local_submap: Planar
    keyframes: list[Keyframe] = field(default_factory=list)


@dataclass(slots=True)
class Submaps:
    """All submaps of one activation, the last being built."""

    keyframe_distance_m: float
    keyframe_angle_rad: float
    submap_keyframes: int
    submaps: list[Submap] = field(default_factory=list)

    def needs_keyframe(self, T_local_base: Planar) -> bool:
        """Tell whether the robot has moved far enough from the last keyframe."""
        if not self.submaps:
            return True
        last = compose(
            self.submaps[-1].T_local_submap, self.submaps[-1].keyframes[-1].T_submap_base
        )
        moved_m = float(np.hypot(*(T_local_base[:2] - last[:2])))
        turned_rad = abs(wrap(T_local_base[2] - last[2]))
        return moved_m > self.keyframe_distance_m or turned_rad > self.keyframe_angle_rad

    def add(self, T_local_base: Planar, scan: LaserScan, surfaces_base: SurfacePoints) -> None:
        """Add a keyframe; a full submap is followed by a new one."""
        if not self.submaps or len(self.submaps[-1].keyframes) >= self.submap_keyframes:
            self.submaps.append(Submap(T_local_submap=T_local_base.copy()))
        submap = self.submaps[-1]
        submap.keyframes.append(
            Keyframe(
                T_submap_base=between(submap.T_local_submap, T_local_base),
                scan=scan,
                surfaces_base=surfaces_base,
            )
        )

    def surroundings(self) -> SurfacePoints:
        """Return the surfaces (local) of the two latest submaps: what to match with."""
        parts = [
            keyframe.surfaces_base.moved(compose(submap.T_local_submap, keyframe.T_submap_base))
            for submap in self.submaps[-2:]
            for keyframe in submap.keyframes
        ]
        return SurfacePoints(
            points=np.concatenate([part.points for part in parts]),
            shape=np.concatenate([part.shape for part in parts]),
            weight=np.concatenate([part.weight for part in parts]),
        )

    def placed(self) -> list[tuple[Planar, Keyframe]]:
        """Return all keyframes with their T_local_base, in the order they were taken."""
        return [
            (compose(submap.T_local_submap, keyframe.T_submap_base), keyframe)
            for submap in self.submaps
            for keyframe in submap.keyframes
        ]


def thin(points: NDArray[np.float32], cell_m: float) -> NDArray[np.float32]:
    """Return one point (the first) per cube of `cell_m`, in their order."""
    cells = np.floor(points / cell_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.asarray(points[np.sort(first)])
