"""What the scans of a CARMEN log say of its laser: where no return begins, and where it is mounted.

A log does not name the number that its driver writes for no return.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.carmen_lines import ScanLine
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_CODES_M = 0.02  # a SICK in millimetres has error codes from 8.183 to 8.191
_BELOW_RATIO = 0.9  # real ranges spread over the tenth below the largest one
_PLACE_M = 0.1  # farther apart, a wall has another range by more than the codes' width
_PLACES_MIN = 10  # a robot that stood still cannot tell a wall from a number for no return
_SPREAD = 0.05  # m, and of the cosine and sine of the yaw: more is no mounting
_FAR_M = 3.0  # no robot carries its laser farther from its centre


def reach_m(scans: Sequence[ScanLine], limit_m: float) -> float:
    """Return the range [m] from which on there is no return, at most `limit_m`.

    A number below it stands for no return if more beams read it than all of the tenth below: a
    wall's range changes as the robot moves. Scans at one place count once.
    """
    scans = _places(scans)
    ranges_m = [_below(scan, limit_m) for scan in scans]
    while any(map(len, ranges_m)):
        largest_m = max(float(one.max()) for one in ranges_m if len(one))
        lowest_m = largest_m - _CODES_M
        codes = np.array([(one >= lowest_m).sum() for one in ranges_m])
        near = sum(int((one >= _BELOW_RATIO * largest_m).sum()) for one in ranges_m) - codes.sum()
        if (codes > 0).sum() < _PLACES_MIN or codes.sum() <= near:
            break
        limit_m = lowest_m
        ranges_m = [one[one < limit_m] for one in ranges_m]
    return limit_m


def mounting(scans: Sequence[ScanLine]) -> Transform | None:
    """Return T_base_laser (4, 4) [m], the median of what lines say; None if that is no mounting.

    Some loggers write a pose of the laser that is zero, or that lags behind the robot's. Each place
    counts once: of a robot that is parked, a wrong one is the same all the time.
    """
    told = [one.T_base_laser for one in _places(scans)]
    mounts = np.array([T_base_laser for T_base_laser in told if T_base_laser is not None])
    if not len(mounts):
        return None
    values = mounts[:, [0, 1, 0, 1], [3, 3, 0, 0]]  # (N, 4): x, y [m], cosine and sine of the yaw
    x_m, y_m, cosine, sine = median = np.median(values, axis=0)
    spread = np.median(np.abs(values - median).max(axis=1))
    if spread > _SPREAD or np.hypot(x_m, y_m) > _FAR_M:
        return None
    return se3.from_xy_yaw(float(x_m), float(y_m), float(np.arctan2(sine, cosine)))


def _places(scans: Sequence[ScanLine]) -> Sequence[ScanLine]:
    """Return one scan of each place of the robot."""
    cells = [np.round(scan.T_odom_base[:2, 3] / _PLACE_M) for scan in scans]
    _, first = np.unique(cells, axis=0, return_index=True)
    return [scans[at] for at in first]


def _below(scan: ScanLine, limit_m: float) -> NDArray[np.float32]:
    """Return the ranges (N,) [m] of the returns below the limit, and the line's own."""
    limit_m = min(limit_m, scan.range_max_m or np.inf)
    return scan.ranges_m[(scan.ranges_m > 0) & (scan.ranges_m < limit_m)]
