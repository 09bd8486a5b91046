"""What the scans of a CARMEN log say of its laser: where no return begins.

A log does not name the number that its driver writes for no return.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.carmen_lines import ScanLine

_CODES_M = 0.02  # a SICK in millimetres has error codes from 8.183 to 8.191
_BELOW_RATIO = 0.9  # real ranges spread over the tenth below the largest one
_PLACE_M = 0.1  # farther apart, a wall has another range by more than the codes' width
_PLACES_MIN = 10  # a robot that stood still cannot tell a wall from a number for no return


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


def _places(scans: Sequence[ScanLine]) -> Sequence[ScanLine]:
    """Return one scan of each place of the robot."""
    cells = [np.round(scan.T_odom_base[:2, 3] / _PLACE_M) for scan in scans]
    _, first = np.unique(cells, axis=0, return_index=True)
    return [scans[at] for at in first]


def _below(scan: ScanLine, limit_m: float) -> NDArray[np.float32]:
    """Return the ranges (N,) [m] of the returns below the limit, and the line's own."""
    limit_m = min(limit_m, scan.range_max_m or np.inf)
    return scan.ranges_m[(scan.ranges_m > 0) & (scan.ranges_m < limit_m)]
