"""Keyframe scans: the latest for scan matching, all for the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Matrix, Planar, wrap

from .surface import ScanSurfaceReader, SurfacePoints, joined


@dataclass(slots=True, kw_only=True, eq=False)
class ScanKeyframe:
    """A scan that is part of the map; its pose may be corrected."""

    stamp_ns: int
    T_local_base: Planar
    T_prev_curr: Planar  # from the previous keyframe, as measured
    covariance: Matrix  # of T_prev_curr, axes of curr
    distance_m: float  # driven since the previous keyframe
    scan: LaserScan


@dataclass(slots=True)
class ScanKeyframes:
    """All keyframes of one activation, in the order they were taken.

    A submap is `submap_keyframes` consecutive keyframes. Scans are matched with the latest two
    submaps, of which the last is being built, as in Cartographer (Hess et al., "Real-time loop
    closure in 2D LIDAR SLAM", ICRA 2016). The surfaces of older keyframes are computed from the
    scan on demand: a scan has a tenth of their size.
    """

    reader: ScanSurfaceReader
    keyframe_distance_m: float
    keyframe_angle_rad: float
    submap_keyframes: int
    frames: list[ScanKeyframe] = field(default_factory=list)
    _surfaces: dict[int, SurfacePoints] = field(default_factory=dict, init=False)  # of the latest

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

    def add(self, frame: ScanKeyframe, surfaces_base: SurfacePoints) -> None:
        """Append a keyframe with its scan's surfaces, in its base."""
        self._surfaces[len(self.frames)] = surfaces_base
        self.frames.append(frame)
        for number in [number for number in self._surfaces if number < self.latest.start]:
            del self._surfaces[number]

    def surfaces_base(self, number: int) -> SurfacePoints:
        """Return a keyframe's surfaces, in its base."""
        kept = self._surfaces.get(number)
        return self.reader.read(self.frames[number].scan) if kept is None else kept

    @property
    def latest(self) -> range:
        """Return the numbers of the keyframes in the latest two submaps."""
        begun = (len(self.frames) - 1) // self.submap_keyframes
        return range(max(begun - 1, 0) * self.submap_keyframes, len(self.frames))

    @property
    def finished_submaps(self) -> int:
        """Return the number of submaps that are no longer used for scan matching."""
        return self.latest.start // self.submap_keyframes

    def of_submap(self, submap: int) -> range:
        """Return the numbers of a submap's keyframes."""
        start = submap * self.submap_keyframes
        return range(start, min(start + self.submap_keyframes, len(self.frames)))

    def around(self, number: int, numbers: range) -> Sequence[int]:
        """Return those of the keyframes `numbers` whose view may overlap that of keyframe `number`.

        The others are left out, so that a jump of the pose does not make the field too large.
        """
        reach_m = 2.0 * self.reader.range_max_m
        centre = self.frames[number].T_local_base
        away = [np.hypot(*(self.frames[i].T_local_base - centre)[:2]) for i in numbers]
        return [i for i, away_m in zip(numbers, away, strict=True) if away_m <= reach_m]

    def surfaces(self, numbers: Sequence[int]) -> SurfacePoints:
        """Return these keyframes' surfaces, in `local`."""
        return joined([self.surfaces_base(i).moved(self.frames[i].T_local_base) for i in numbers])

    def move(self, poses: NDArray[np.float64]) -> None:
        """Set new poses T_local_base (N, 3) [m, m, rad] of all keyframes."""
        for frame, T_local_base in zip(self.frames, poses, strict=True):
            frame.T_local_base = np.asarray(T_local_base)

    @property
    def poses(self) -> NDArray[np.float64]:
        """Return T_local_base (N, 3) [m, m, rad] of all keyframes."""
        return np.array([frame.T_local_base for frame in self.frames]).reshape(-1, 3)
