"""Check of wheel odometry by the motion that a laser or depth camera measures."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Laser, Rig

_SPAN_S = 0.4  # time between compared scans, at most twice as long
_SPAN_MAX_S = 0.8
_FORWARD_MAX_M, _TURN_MAX_RAD = 0.8, 0.5  # search range: 2 m/s and 70 degrees/s
_COARSE = (21, 17)  # numbers of steps: 8 cm and 3.6 degrees ...
_FINE = (9, 9)  # ... then 2 cm and 0.9 degrees around the best
_BEAMS = 60  # compared beams per scan
_CLIP_M = 0.3  # larger differences are clipped: other surfaces
_OVERLAP_RATIO = 0.5  # smallest share of beams in both scans
_MISFIT_M = 0.03  # largest extra misfit of the wheels' motion: three times a laser's noise of 1 cm
_STANDING_M, _STANDING_RAD = 0.01, 0.01
_MOST = 10.0  # ratio if the wheels report no motion although the robot moves

Planar = NDArray[np.float64]  # (N, 2) [m], base


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Scan:
    """A scan in `base`, by rising angle."""

    stamp_ns: int
    angles_rad: NDArray[np.float64]  # (N,)
    ranges_m: NDArray[np.float64]  # (N,)
    T_odom_base: se3.Transform


class WheelCheck:
    """Computes the ratio of the true motion, by two scans, to that of the wheels.

    Among all motions of a wheeled robot, the one that best aligns the two scans is searched. If the
    wheels' motion aligns them as well, as in a bare corridor, the wheels count as correct. Of a
    depth image, the row at the camera's height is used.
    """

    def __init__(self, rig: Rig) -> None:
        self._laser, self._camera = rig.laser, rig.camera
        self._known: deque[_Scan] = deque()
        self._ratio, self._found_ns = 1.0, 0

    def __call__(self, observation: Observation) -> float:
        """Return 1 for correct wheels, 0 if they spin, below 0 if reversed, 10 if blocked."""
        scan = self._scan(observation)
        if scan is not None:
            self._compare(scan)
        is_old = observation.stamp_ns - self._found_ns > _SPAN_MAX_S * 1e9
        return 1.0 if is_old else self._ratio

    def _compare(self, now: _Scan) -> None:
        self._known.append(now)
        while len(self._known) > 1 and now.stamp_ns - self._known[1].stamp_ns >= _SPAN_S * 1e9:
            self._known.popleft()
        before = self._known[0]
        if _SPAN_S <= (now.stamp_ns - before.stamp_ns) * 1e-9 <= _SPAN_MAX_S:
            self._ratio, self._found_ns = _ratio(before, now), now.stamp_ns

    def _scan(self, observation: Observation) -> _Scan | None:
        """Return the observation's scan in base, None without one or without odometry."""
        T_odom_base = observation.T_odom_base
        if T_odom_base is None or not np.isfinite(T_odom_base).all():
            return None
        if observation.scan is not None and self._laser is not None:
            points = _of_scan(observation.scan, self._laser)
        elif self._laser is None and observation.depth_m is not None and self._camera is not None:
            points = _of_depth(observation.depth_m, self._camera)
        else:
            return None
        if len(points) < _BEAMS // 2:
            return None
        angles_rad = np.arctan2(points[:, 1], points[:, 0])
        order = np.argsort(angles_rad)
        return _Scan(
            stamp_ns=observation.stamp_ns,
            angles_rad=angles_rad[order],
            ranges_m=np.hypot(*points[order].T),
            T_odom_base=T_odom_base,
        )


def _ratio(before: _Scan, now: _Scan) -> float:
    """Return the measured forward motion over that of the wheels, 1 if these are correct."""
    T_prev_curr = se3.inverse(before.T_odom_base) @ now.T_odom_base
    wheels_m, wheels_rad = float(T_prev_curr[0, 3]), se3.yaw_rad(T_prev_curr)
    grid_m, grid_rad = (
        np.linspace(-end, end, count)
        for end, count in zip((_FORWARD_MAX_M, _TURN_MAX_RAD), _COARSE, strict=True)
    )
    seen_m, seen_rad, _ = _best(before, now, grid_m, grid_rad)
    steps = (grid_m[1] - grid_m[0], grid_rad[1] - grid_rad[0])
    seen_m, seen_rad, misfit_m = _best(before, now, *_around(seen_m, seen_rad, steps))
    # Tolerance for correct wheels: half a coarse step.
    claim = _around(wheels_m, wheels_rad, (steps[0] / 4, steps[1] / 2))
    if _best(before, now, *claim)[2] - misfit_m < _MISFIT_M:
        return 1.0
    if abs(wheels_m) < _STANDING_M and abs(wheels_rad) < _STANDING_RAD:
        return _MOST
    return float(np.clip(seen_m / wheels_m, -_MOST, _MOST)) if abs(wheels_m) > _STANDING_M else 1.0


def _around(
    forward_m: float, turn_rad: float, ends: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (
        forward_m + np.linspace(-ends[0], ends[0], _FINE[0]),
        turn_rad + np.linspace(-ends[1], ends[1], _FINE[1]),
    )


def _best(
    before: _Scan, now: _Scan, forward_m: NDArray[np.float64], turn_rad: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Return the best motion (forward [m], turn [rad]) and its mean misfit [m]."""
    step = max(1, len(now.angles_rad) // _BEAMS)
    angles_rad, ranges_m = now.angles_rad[::step], now.ranges_m[::step]
    turned_rad = turn_rad[:, None] + angles_rad  # (A, N)
    # The motion is an arc, whose chord has half the turn as direction.
    along = np.exp(0.5j * turn_rad)[:, None] * forward_m[:, None, None]  # (D, A, 1)
    ends = ranges_m * np.exp(1j * turned_rad) + along  # (D, A, N) x + iy
    expected_m = np.interp(
        np.angle(ends), before.angles_rad, before.ranges_m, left=np.nan, right=np.nan
    )
    off_m = np.minimum(np.abs(np.abs(ends) - expected_m), _CLIP_M)
    counts = np.count_nonzero(~np.isnan(off_m), axis=2)
    misfits_m = np.nansum(off_m, axis=2) / np.maximum(counts, 1)
    misfits_m[counts < _OVERLAP_RATIO * len(ranges_m)] = _CLIP_M
    d, a = np.unravel_index(int(np.argmin(misfits_m)), misfits_m.shape)
    return float(forward_m[d]), float(turn_rad[a]), float(misfits_m[d, a])


def _of_scan(scan: LaserScan, laser: Laser) -> Planar:
    is_hit = np.isfinite(scan.ranges_m) & (scan.ranges_m > scan.range_min_m)
    ranges_m, angles_rad = scan.ranges_m[is_hit], scan.angles_rad[is_hit]
    points_laser = np.column_stack(
        [ranges_m * np.cos(angles_rad), ranges_m * np.sin(angles_rad), np.zeros(len(ranges_m))]
    )
    return np.asarray(se3.apply(laser.T_base_laser, points_laser.astype(np.float64))[:, :2])


def _of_depth(depth_m: NDArray[np.float32], camera: Camera) -> Planar:
    """Return the points (N, 2) [m], base, of the row at the camera's height."""
    row = int(np.clip(round(camera.cy), 2, depth_m.shape[0] - 3))
    smooth_m = cv2.medianBlur(np.ascontiguousarray(depth_m[row - 2 : row + 3]), 5)[2]
    columns = np.flatnonzero(camera.measures(smooth_m))
    z_m = smooth_m[columns].astype(np.float64)
    x_m = (columns - camera.cx) / camera.fx * z_m
    points_cam = np.column_stack([x_m, np.zeros_like(z_m), z_m])
    return np.asarray(se3.apply(camera.T_base_cam, points_cam)[:, :2])
