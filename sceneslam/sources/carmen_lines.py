"""Parsing of the lines of a CARMEN log."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import parse_stamp_ns

FLASER, ROBOTLASER = b"FLASER ", b"ROBOTLASER1 "
IPC_STAMP, LOGGER_STAMP = -3, -1  # places in a line, from its end: when received, when logged
_HALF_TURN_DEG = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5}  # SICK LMS: degrees per beam
_MIDDLE_DEG = {400: 0.25, 401: 0.25}  # which it measures over 100 degrees alone, in the middle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanLine:
    """One scan and the odometry at it."""

    ranges_m: NDArray[np.float32]  # (N,) as logged
    angle_min_rad: float
    angle_step_rad: float
    range_max_m: float | None  # None: not in the line
    T_odom_base: Transform
    T_base_laser: Transform | None  # None: not in the line


def parse_scan(line: bytes) -> ScanLine | None:
    """Return the scan of a FLASER or ROBOTLASER1 line, None if the line is invalid."""
    try:
        scan = _flaser(line) if line.startswith(FLASER) else _robotlaser(line)
    except (ValueError, IndexError, OverflowError):
        return None
    return scan if _is_finite(scan) else None


def stamp_of(line: bytes, place: int = IPC_STAMP) -> int:
    """Return the stamp [ns] of a line at `place`, IPC_STAMP or LOGGER_STAMP; 0 if invalid."""
    words = line.rsplit(maxsplit=3)
    try:
        return parse_stamp_ns(words[place].decode()) if len(words) == 4 else 0
    except ValueError:
        return 0


def position_of(line: bytes) -> tuple[float, float]:
    """Return the wheels' position [m] in a line, NaN if invalid."""
    after = 6 if line.startswith(FLASER) else 11  # words from there to the end of the line
    words = line.rsplit(maxsplit=after)[1:3]
    try:
        return float(words[0]), float(words[1])
    except (ValueError, IndexError):
        return math.nan, math.nan


def _is_finite(scan: ScanLine) -> bool:
    """Tell whether all values but the ranges are finite (a range that is not: no return)."""
    T_base_laser = scan.T_odom_base if scan.T_base_laser is None else scan.T_base_laser
    angles_rad = (scan.angle_min_rad, scan.angle_step_rad)
    return all(np.isfinite(values).all() for values in (scan.T_odom_base, T_base_laser, angles_rad))


def _flaser(line: bytes) -> ScanLine:
    """Parse FLASER count [ranges] x y theta odom_x odom_y odom_theta ipc_time host logger_time."""
    words = line.split()
    count = int(words[1])
    ranges_m = _numbers(words, 2, count)
    _, _, _, x_m, y_m, yaw_rad = map(float, words[2 + count : 8 + count])
    step_deg = (_HALF_TURN_DEG | _MIDDLE_DEG).get(count, 180.0 / max(count - 1, 1))
    first_deg = -step_deg * (count - 1) / 2 if count in _MIDDLE_DEG else -90.0
    return ScanLine(
        ranges_m=ranges_m,
        angle_min_rad=float(np.deg2rad(first_deg)),
        angle_step_rad=float(np.deg2rad(step_deg)),
        range_max_m=None,
        T_odom_base=se3.from_xy_yaw(x_m, y_m, yaw_rad),
        T_base_laser=None,
    )


def _robotlaser(line: bytes) -> ScanLine:
    """Parse ROBOTLASER1 type start fov step range_max accuracy mode count [ranges] ...

    ... count [remissions] laser x y theta, robot x y theta, tv rv forward side turn, ipc_time host
    logger_time.
    """
    words = line.split()
    start_rad, _, step_rad, range_max_m = map(float, words[2:6])
    count = int(words[8])
    ranges_m = _numbers(words, 9, count)
    after = 9 + count + 1 + int(words[9 + count])
    laser, robot = (se3.from_xy_yaw(*map(float, words[at : at + 3])) for at in (after, after + 3))
    return ScanLine(
        ranges_m=ranges_m,
        angle_min_rad=start_rad,
        angle_step_rad=step_rad,
        range_max_m=range_max_m,
        T_odom_base=robot,
        T_base_laser=se3.inverse(robot) @ laser,
    )


def _numbers(words: list[bytes], start: int, count: int) -> NDArray[np.float32]:
    ranges_m = np.array(words[start : start + count], dtype=np.float32)
    if count < 2 or len(ranges_m) != count:
        raise ValueError("too few ranges")
    return ranges_m
