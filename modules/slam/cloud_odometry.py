"""A library that registers clouds, as a SLAM module: what it is not, is here.

Such libraries answer with a pose whatever they are given. Around them: the motion model's
prediction, the bounds of a robot's motion, the overlap with what was seen before, the directions
that a cloud's shape leaves open, the covariance, and the states that follow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.model import Motion, MotionModel
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import MapLayers, PointLayer
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.trajectory import Trajectory

from .cloud_shape import cloud_localizability
from .clouds import Cloud, CloudReader
from .degeneracy import Localizability
from .known_voxels import KnownVoxels

_POINTS_MIN = 50  # fewer do not hold six degrees of freedom
_SHAPE_POINTS = 10_000  # suffice for the shape of a cloud
_DEPTH_VOXEL_M = 0.1
_COAST_S = 0.5  # without a good cloud for longer, a guessed pose is no pose
_CERTAIN = 1e-8 * np.eye(6)  # covariance of a pose that is so by definition
_UNSEEN = 1e-6 * np.eye(6)  # information along a direction that is not measured


class CloudMap(Protocol):
    """A library's map, in `local`."""

    def register(
        self, cloud: Cloud, T_local_guess: se3.Transform, observation: Observation
    ) -> se3.Transform | None:
        """Return T_local_base of a cloud (N, 3) [m] in base, None where the library refuses it."""
        ...

    def accept(self, T_local_base: se3.Transform) -> None:
        """Let the cloud registered last become part of the map, at this pose."""
        ...

    def points(self) -> NDArray[Any]:
        """Return the map's points (N, 3) [m]."""
        ...


@dataclass(slots=True, kw_only=True)
class CloudLimits:
    """When a registration is believed, and how far; the YAML says what the values are."""

    noise_voxels: float
    noise_rad: float
    overlap_min_ratio: float
    weak_ratio: float
    speed_max_m_s: float
    turn_max_rad_s: float

    def __post_init__(self) -> None:
        """Check the values."""
        for field in fields(self):
            is_ratio = field.name.endswith("_ratio")
            value = getattr(self, field.name)
            if is_ratio and not 0 <= value < 1:
                raise ConfigError(field.name, value, "0 (never) to below 1")
            if not is_ratio and not 0 < value < np.inf:
                raise ConfigError(field.name, value, "above 0")


class CloudOdometry:
    """Fulfils all of `SlamModule` but `requires`."""

    def __init__(
        self,
        make_map: Callable[[float, float], CloudMap],
        limits: CloudLimits,
        *,
        voxel_m: float | None,
        depth_range_max_m: float = 6.0,
        depth_stride_px: int = 8,
    ) -> None:
        """Take what makes the library's map of a voxel's edge and the sensor's range [m]."""
        for name, value in (
            ("voxel_m", voxel_m),
            ("depth_range_max_m", depth_range_max_m),
            ("depth_stride_px", depth_stride_px),
        ):
            if value is not None and not 0 < value < np.inf:
                raise ConfigError(name, value, "above 0")
        self._make_map, self._limits, self._given_voxel_m = make_map, limits, voxel_m
        self._depth = {"depth_range_max_m": depth_range_max_m, "depth_stride_px": depth_stride_px}
        self._reader: CloudReader | None = None
        self._map: CloudMap | None = None
        self._T_map_local = se3.identity()
        self._T_local_base = se3.identity()

    def activate(self, rig: Rig) -> None:
        """Start anew, with the lidar where there is one, else with the depth camera."""
        self._reader = CloudReader(rig, **self._depth)  # type: ignore[arg-type]
        range_max_m = self._reader.range_m[1]
        derived_m = _DEPTH_VOXEL_M if self._reader.is_depth else range_max_m / 100.0
        self._voxel_m = self._given_voxel_m or derived_m
        self._map = self._make_map(self._voxel_m, range_max_m)
        noise = [self._limits.noise_voxels * self._voxel_m, self._limits.noise_rad]
        self._precision = np.diag(1.0 / np.repeat(noise, 3) ** 2)  # of a registration
        self._known = KnownVoxels(self._voxel_m)
        self._motion = MotionModel(rig)
        self._T_map_local, self._T_local_base = se3.identity(), se3.identity()
        self._T_local_held = se3.identity()  # by the latest good cloud
        self._held_ns: int | None = None
        self._marked_at = np.zeros(3)
        self._covariance = _CERTAIN  # of the pose in base, beside the map around

    def set_pose(self, T_map_local: se3.Transform) -> None:
        """Place `local` in the map."""
        self._T_map_local = np.array(T_map_local, dtype=np.float64)

    def set_scene(self, scene: str) -> None:
        """Do nothing: geometry is the same by day and by night."""

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base at the observation."""
        if self._reader is None or self._map is None:
            raise RuntimeError("track() before activate()")
        velocity = self._motion.velocity
        motion = self._motion.predict(observation)
        T_local_guess = se3.orthonormal(self._T_local_base @ motion.T_prev_curr)
        carry = se3.adjoint(se3.inverse(motion.T_prev_curr))
        self._covariance = carry @ self._covariance @ carry.T + motion.covariance
        cloud = self._reader.read_unswept(observation, velocity)
        if cloud is None:
            return self._bridge(observation, T_local_guess, motion, can_coast=True)
        if len(cloud) < _POINTS_MIN:
            return self._bridge(observation, T_local_guess, motion, can_coast=False)
        T_local_icp = self._map.register(cloud, T_local_guess, observation)
        if T_local_icp is None or not self._is_plausible(observation.stamp_ns, T_local_icp):
            return self._bridge(observation, T_local_guess, motion, can_coast=False)
        inliers = self._known.count(se3.apply(T_local_icp, cloud))
        overlap_ratio = inliers / len(cloud) if self._held_ns is not None else 1.0
        if overlap_ratio < self._limits.overlap_min_ratio:
            return self._bridge(observation, T_local_guess, motion, can_coast=False)
        thinned = cloud[:: max(1, round(len(cloud) / _SHAPE_POINTS))]
        shape = cloud_localizability(thinned, 2.0 * self._voxel_m)
        T_local_base = self._fuse(T_local_guess, T_local_icp, shape, motion)
        self._hold(observation.stamp_ns, T_local_base, cloud)
        is_weak = shape.ratios[0] < self._limits.weak_ratio
        status = TrackingStatus.DEGRADED if is_weak else TrackingStatus.TRACKING
        return self._answer(observation, status, overlap_ratio, inliers)

    def get_pose(self) -> se3.Transform:
        """Return T_map_base of the last observation."""
        return self._T_map_local @ self._T_local_base

    def get_trajectory(self) -> Trajectory:
        """Return no poses: a map that moves along revises nothing."""
        return Trajectory.empty()

    def get_map(self) -> MapLayers:
        """Return the map's points in `local`."""
        if self._map is None or self._held_ns is None:
            return MapLayers()
        return MapLayers(points=PointLayer(points=self._map.points().astype(np.float32)))

    def shutdown(self) -> None:
        """Free the ray table; the map stays."""
        self._reader = None

    def _is_plausible(self, stamp_ns: int, T_local_icp: se3.Transform) -> bool:
        """Tell whether a robot can have moved so, in the time since the last good cloud."""
        if not np.isfinite(T_local_icp).all():
            return False
        if self._held_ns is None:
            return True
        moved = se3.inverse(self._T_local_held) @ T_local_icp
        duration_s = (stamp_ns - self._held_ns) * 1e-9
        limits = self._limits
        return bool(
            np.linalg.norm(moved[:3, 3]) <= limits.speed_max_m_s * duration_s + self._voxel_m
            and se3.rotation_angle_rad(moved) <= limits.turn_max_rad_s * duration_s
        )

    def _fuse(
        self,
        T_local_guess: se3.Transform,
        T_local_icp: se3.Transform,
        shape: Localizability,
        motion: Motion,
    ) -> se3.Transform:
        """Return the pose between the prediction's and the library's, and teach the prediction.

        Where nothing measures the motion, the library's answer stands, but for the directions that
        the cloud's shape leaves open: there the prediction does.
        """
        held = shape.held(self._limits.weak_ratio)
        information = held.T @ self._precision @ held
        predicted = self._covariance
        fused = np.linalg.inv(np.linalg.inv(predicted) + information)
        if self._held_ns is None:
            self._motion.skip()
            return T_local_icp
        self._covariance = np.asarray(0.5 * (fused + fused.T), np.float64)
        T_before_now = se3.inverse(self._T_local_held) @ T_local_icp
        self._motion.learn(T_before_now, np.asarray(np.linalg.inv(information + _UNSEEN)))
        gain = fused @ information if motion.is_measured else held
        off = se3.log(se3.inverse(T_local_guess) @ T_local_icp)
        return se3.orthonormal(T_local_guess @ se3.exp(gain @ off))

    def _hold(self, stamp_ns: int, T_local_base: se3.Transform, cloud: Cloud) -> None:
        assert self._map is not None and self._reader is not None
        self._map.accept(T_local_base)
        self._T_local_base = self._T_local_held = T_local_base
        self._held_ns = stamp_ns
        if np.linalg.norm(T_local_base[:3, 3] - self._marked_at) > 0.5 * self._reader.range_m[1]:
            self._known.reset(self._map.points())  # a map that moves along forgets
            self._marked_at = T_local_base[:3, 3]
        self._known.add(se3.apply(T_local_base, cloud))

    def _bridge(
        self,
        observation: Observation,
        T_local_guess: se3.Transform,
        motion: Motion,
        *,
        can_coast: bool,
    ) -> Tracking:
        """Go on without a cloud: by odometry, for a moment as before, else not at all."""
        since_ns = observation.stamp_ns - (self._held_ns or 0)
        is_brief = can_coast and self._held_ns is not None and since_ns <= _COAST_S * 1e9
        if motion.is_measured or is_brief:
            self._T_local_base = T_local_guess
            status = TrackingStatus.TRACKING if is_brief else TrackingStatus.DEGRADED
            return self._answer(observation, status, 0.0, 0)
        self._motion.stop()
        self._T_local_base = self._T_local_held
        return self._answer(observation, TrackingStatus.LOST, 0.0, 0)

    def _answer(
        self, observation: Observation, status: TrackingStatus, quality_ratio: float, inliers: int
    ) -> Tracking:
        return Tracking(
            stamp_ns=observation.stamp_ns,
            T_local_base=self._T_local_base.copy(),
            status=status,
            covariance=None if status is TrackingStatus.LOST else self._covariance.copy(),
            quality_ratio=quality_ratio,
            inliers=inliers,
        )
