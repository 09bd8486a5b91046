"""The free space of the latest keyframes: what their beams passed through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Planar, rotation
from sceneslam.types.se3 import Transform

_MARGIN_M = 0.2  # around a point that is free, of poses, beams, and walls seen at a flat angle


class FreeSpace:
    """Tells which points of `local` were seen to be free, with a margin around them."""

    def __init__(
        self,
        scans: Sequence[LaserScan],
        T_local_base: Sequence[Planar],
        T_base_laser: Transform,
        range_max_m: float,
    ) -> None:
        """Take scans of one sensor and the poses (3,) at which they were taken.

        Those with other beams than the newest are left out. Nothing is known along beams without a
        return within `range_max_m`.
        """
        same = [
            (scan, pose)
            for scan, pose in zip(scans, T_local_base, strict=True)
            if _beams(scan) == _beams(scans[-1])
        ]
        ranges = np.array([scan.ranges_m for scan, _ in same], np.float64)
        self._least = _least(np.where(ranges <= range_max_m, ranges, 0.0))  # inf, nan: unknown
        R_local_base = np.array([rotation(pose[2]) for _, pose in same])
        self._R_local_laser = R_local_base @ T_base_laser[:2, :2]  # mirrored if it hangs
        base = np.array([pose[:2] for _, pose in same])
        self._position = base + R_local_base @ T_base_laser[:2, 3]
        _, self._first_rad, self._step_rad = _beams(scans[-1])

    def contains(self, points_local: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell for each of the points (N, 2) [m] whether the beams of a scan passed around it."""
        away = (points_local[None] - self._position[:, None]) @ self._R_local_laser
        distance = np.hypot(away[..., 0], away[..., 1])
        angle = np.arctan2(away[..., 1], away[..., 0]) - self._first_rad
        angle *= np.sign(self._step_rad)
        beam = angle % (2 * np.pi) / abs(self._step_rad)
        half = _MARGIN_M / np.maximum(distance, _MARGIN_M) / abs(self._step_rad)
        first = np.floor(beam - half).astype(np.int64)
        count = np.ceil(beam + half).astype(np.int64) - first + 1
        level = np.minimum(np.log2(count).astype(np.int64), len(self._least) - 1)
        row, last = np.arange(len(away))[:, None], self._least.shape[2] - 1
        ends = (first, first + count - (1 << level))
        least = [
            np.where((i >= 0) & (i <= last), self._least[level, row, np.clip(i, 0, last)], 0.0)
            for i in ends
        ]
        return np.asarray((distance + _MARGIN_M < np.minimum(*least)).any(axis=0))


def _beams(scan: LaserScan) -> tuple[int, float, float]:
    return len(scan.ranges_m), scan.angle_min_rad, scan.angle_step_rad


def _least(ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the least (L, K, N) of the 2^l ranges (K, N) from each beam on, 0 past the last."""
    levels = [ranges]
    for level in range(1, int(np.log2(max(ranges.shape[1], 1))) + 1):
        before, half = levels[-1], 1 << (level - 1)
        after = np.zeros_like(before)
        after[:, :-half] = before[:, half:]
        levels.append(np.minimum(before, after))
    return np.array(levels)
