"""Horizontal scans for place recognition, from laser, lidar or depth camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.depth_scan import DepthScanner
from sceneslam.scans.deskew import deskewed
from sceneslam.scans.lidar_scan import LidarScanner
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.types.trail import Trail

_LEVEL_COS = np.cos(np.radians(5.0))  # lasers with more tilt measure floor and ceiling
_BEAMS = 360  # of a lidar's revolution
_DEPTH_BEAMS, _STRIDE_PX = 160, 4  # a beam is one cell wide at the largest range
_REACH = 3  # neighbours to either side for the fit of a line
_SHORTEST_M, _LONGEST_M = 0.03, 1.5  # from the first neighbour to the last: a degree at 14 m
_FLAT_RATIO = 0.1  # largest distance of a neighbour to the line, of its length ...
_FLAT_M = (0.02, 0.06)  # ... but within range noise
_FAR_M = 15.0  # beyond, beams of a degree are five cells apart


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeyScan:
    """The end points of a scan's beams in the x-y plane of `base`."""

    stamp_ns: int
    points: NDArray[np.float32]  # (N, 2) [m], base, by rising angle
    origin: NDArray[np.float64]  # (2,) [m], base: the beams' origin


class KeyScanner:
    """Makes scans of observations, by the rig's sensor with the widest field of view."""

    def __init__(self, rig: Rig) -> None:
        self._sensors, self._laser = rig.sensors, rig.laser
        if self._laser is not None and abs(self._laser.T_base_laser[2, 2]) < _LEVEL_COS:
            self._laser = None
        self._lidar: LidarScanner | None = None
        if rig.lidar is not None:
            self._T_base_lidar = rig.lidar.T_base_lidar
            self._lidar = LidarScanner(rig.lidar, beams=_BEAMS)
        self._depth: DepthScanner | None = None
        if rig.camera is not None:
            try:
                self._depth = DepthScanner(rig.camera, beams=_DEPTH_BEAMS, stride_px=_STRIDE_PX)
            except ConfigError:  # it sees only the floor or the ceiling
                self._depth = None

    @property
    def can_scan(self) -> bool:
        """Tell whether the rig has a sensor that sees walls."""
        made = {Sensor.SCAN: self._laser, Sensor.POINTS: self._lidar, Sensor.DEPTH: self._depth}
        return any(sensor in self._sensors for sensor, by in made.items() if by is not None)

    def make(self, observation: Observation, trail: Trail) -> KeyScan | None:
        """Return the scan of the newest observation of a trail, None without a suitable sensor."""
        if observation.scan is not None and self._laser is not None:
            T_base_laser = trail.base_at(observation.scan.stamp_ns) @ self._laser.T_base_laser
            return _key_scan(observation.stamp_ns, observation.scan, T_base_laser)
        if observation.points_lidar is not None and self._lidar is not None:
            points = deskewed(observation, self._T_base_lidar, trail.twist_s)
            scan = self._lidar.scan(points, stamp_ns=observation.stamp_ns)
            return _key_scan(observation.stamp_ns, scan, self._lidar.T_base_laser)
        if observation.depth_m is not None and self._depth is not None:
            scan = self._depth.scan(observation.depth_m, stamp_ns=observation.stamp_ns)
            return _key_scan(observation.stamp_ns, scan, self._depth.T_base_laser)
        return None


def _key_scan(stamp_ns: int, scan: LaserScan, T_base_laser: Transform) -> KeyScan:
    ranges_m, angles = scan.ranges_m.astype(np.float64), scan.angles_rad.astype(np.float64)
    farthest_m = min(scan.range_max_m, _FAR_M)
    valid = (ranges_m > scan.range_min_m) & (ranges_m < farthest_m)  # false for NaN
    ranges_m, angles = ranges_m[valid], angles[valid]
    points = np.column_stack(
        [ranges_m * np.cos(angles), ranges_m * np.sin(angles), np.zeros(len(angles))]
    )
    points_base = np.asarray(se3.apply(T_base_laser, points)[:, :2], np.float32)
    return KeyScan(stamp_ns=stamp_ns, points=points_base, origin=T_base_laser[:2, 3].copy())


def line_normals(scan: KeyScan) -> NDArray[np.float64]:
    """Return the unit normals (N, 2), base, towards the sensor, of lines through neighbours.

    Zero if the neighbours are too far apart, or not on a line.
    """
    points, origin = scan.points.astype(np.float64), scan.origin
    normals = np.zeros_like(points)
    count = len(points)
    if count < 2 * _REACH + 1:
        return normals
    inner = slice(_REACH, count - _REACH)
    before, after = points[: count - 2 * _REACH], points[2 * _REACH :]
    along = after - before
    length_m = np.linalg.norm(along, axis=1)
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(length_m, 1e-9)[:, None]
    spread_m = np.zeros(len(along))
    for shift in range(1, 2 * _REACH):
        between = points[shift : shift + len(along)]
        spread_m = np.maximum(spread_m, np.abs(((between - before) * normal).sum(axis=1)))
    towards = np.sign(((origin - points[inner]) * normal).sum(axis=1))
    is_line = (length_m > _SHORTEST_M) & (length_m < _LONGEST_M)
    is_line &= spread_m < np.clip(_FLAT_RATIO * length_m, *_FLAT_M)
    normals[inner] = normal * (towards * is_line)[:, None]
    return normals
