"""Removal of values that are not finite, and of invalid images and odometry, from observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros.pixels import locked
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Sensor
from sceneslam.types.se3 import Transform, orthonormal

_FAR_M = 1e8  # more than twice around the Earth
_ROUNDED = 1e-12  # rounding error per step; more would accumulate over a million steps
_SKEW_MAX = 1e-3  # of R^T R off the identity; the rounding of float32 is a thousandth of that


def cleaned(observation: Observation, log: FaultLog, camera: Camera | None = None) -> Observation:
    """Return the observation with finite arrays; the same object if nothing had to be removed.

    Depth that is not finite becomes 0, missing (REP-118); the time of a point, that of its
    observation. Images that are empty or not of the camera's size, points and gyro samples that are
    not finite, and odometry that is not a valid pose, are left out. All but depth is counted in
    `log`.
    """
    changes = {
        **_pictures(observation, log, camera),
        **_points(observation, log),
        **_motion(observation, log),
    }
    return replace(observation, **changes) if changes else observation  # type: ignore[arg-type]


def _pictures(
    observation: Observation, log: FaultLog, camera: Camera | None
) -> Mapping[str, object]:
    changes: dict[str, object] = {}
    for name in ("image_bgr", "depth_m"):
        picture = getattr(observation, name)
        fault = None if picture is None else _fault(name, picture, camera)
        if fault is not None:
            log.add(fault, at_stamp(observation.stamp_ns))
            changes[name] = None
    depth_m = observation.depth_m
    if depth_m is None or "depth_m" in changes:
        return changes
    is_good = np.isfinite(depth_m)
    if not is_good.all():
        changes["depth_m"] = locked(np.where(is_good, depth_m, np.float32(0)))
        if not is_good.any():
            log.add("depth image without one finite value", at_stamp(observation.stamp_ns))
    return changes


def _fault(name: str, picture: NDArray[Any], camera: Camera | None) -> str | None:
    """Return why an image (H, W, ...) cannot be used, None if it can."""
    size_wh = picture.shape[1::-1]
    if picture.size == 0:
        return f"empty {name}"
    if camera is None or size_wh == tuple(camera.size_wh):
        return None
    size, expected = ("x".join(map(str, each)) for each in (size_wh, camera.size_wh))
    return f"{name} was left out, it has {size} pixels, not {expected}"


def _points(observation: Observation, log: FaultLog) -> Mapping[str, object]:
    points, times_s = observation.points_lidar, observation.point_times_s
    changes: dict[str, object] = {}
    if points is not None and not np.isfinite(points).all():
        is_good = np.isfinite(points).all(axis=1)
        log.add("points that are not finite", at_stamp(observation.stamp_ns))
        changes["points_lidar"] = locked(points[is_good])
        if times_s is not None:
            changes["point_times_s"] = times_s = locked(times_s[is_good])
    if times_s is not None and not np.isfinite(times_s).all():
        log.add("times of points that are not finite", at_stamp(observation.stamp_ns))
        changes["point_times_s"] = locked(np.where(np.isfinite(times_s), times_s, 0.0))
    return changes


def _motion(observation: Observation, log: FaultLog) -> Mapping[str, object]:
    changes: dict[str, object] = {}
    T_odom_base = observation.T_odom_base
    if T_odom_base is not None and not np.isfinite(T_odom_base).all():
        log.add("odometry that is not finite", at_stamp(observation.stamp_ns))
        changes["T_odom_base"] = None
    elif T_odom_base is not None:
        skew = _skew(T_odom_base)
        if not skew <= _SKEW_MAX:
            log.add("odometry is not a valid pose", at_stamp(observation.stamp_ns))
            changes["T_odom_base"] = None
        elif skew > _ROUNDED:
            changes["T_odom_base"] = locked(orthonormal(T_odom_base))
    for sensor in (sensor for sensor in Sensor if sensor.is_sampled):
        samples = getattr(observation, sensor.field)
        if samples is not None and not np.isfinite(samples).all():
            is_good = np.isfinite(samples).all(axis=1)
            bad = int(np.count_nonzero(~is_good))
            log.add(
                f"{sensor.value} sample that is not finite", at_stamp(observation.stamp_ns), bad
            )
            changes[sensor.field] = locked(samples[is_good]) if is_good.any() else None
    return changes


def _skew(T_odom_base: Transform) -> float:
    """Return the largest entry of |R^T R - I|; inf for an impossible position."""
    if T_odom_base.shape != (4, 4) or np.abs(T_odom_base[:3, 3]).max() > _FAR_M:
        return np.inf
    return float(se3.skew(T_odom_base))
