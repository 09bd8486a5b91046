"""A SLAM module by a cloud registration library, with prediction, checks and tracker states.

Such libraries return a pose for any input, also for empty clouds, NaN or a bare corridor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import ClassVar

import numpy as np

from sceneslam.motion.inertia import FASTEST
from sceneslam.motion.predictor import Prediction, Predictor
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import MapLayers, PointLayer
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.ranges import Checked, check_above, check_between, ranged
from sceneslam.types.rig import Rig, Sensor

from .cloud_map import CloudMap
from .clouds import Cloud, CloudReader
from .degeneracy import Localizability
from .local import LocalModule

_POINTS_MIN = 50  # fewer do not constrain six degrees of freedom
_DEPTH_VOXEL_M = 0.1
# Deviations of what two clouds say of the motion between them: over that of a pose, since most of
# its error is that of the map, which both share (0.05 to 0.14 voxels remain), and of the turn.
_STEP_RATIO, _STEP_RAD = 0.25, 0.0025
_SIGMAS = 2.0  # of the robot's motion since the last cloud: how far a guess may be off
_INTERVAL_S, _SHARE = 1.0, 0.1  # usual interval of clouds at first, and weight of the newest
_INTERRUPTED = 3.0  # times the usual interval between two poses
_SAME_RATIO = 0.9  # of a cloud in known voxels: it shows what was seen before the interruption
_DIFFUSE = 1e6  # prediction's variances in units of a cloud's, if ICP decides alone


@dataclass(kw_only=True, eq=False)
class CloudOdometry(LocalModule, Checked, ABC):
    """Implements `SlamModule` by a `CloudMap`; the settings are described in each YAML file."""

    library: ClassVar[str | None] = None  # an extra that has to be installed, named as its package
    voxel_m: float | None = ranged(check_above, 0)
    depth_range_max_m: float = ranged(check_above, 0)
    depth_stride_px: int = ranged(check_above, 0)
    deskew: bool
    noise_m: float | None = ranged(check_above, 0)
    overlap_min_ratio: float = ranged(check_between, 0, 1)
    weak_ratio: float
    speed_max_m_s: float | None = ranged(check_above, 0)
    turn_max_rad_s: float = ranged(check_above, 0)
    _reader: CloudReader | None = field(default=None, init=False)
    _icp: CloudMap | None = field(default=None, init=False)
    _predictor: Predictor = field(init=False)

    def __post_init__(self) -> None:
        """Check the settings, and that the library is installed."""
        if self.library is not None and find_spec(self.library) is None:
            name = type(self).__name__
            raise ConfigError("_target_", name, f"pip install 'sceneslam[{self.library}]'")
        super().__post_init__()
        if not 0 <= self.weak_ratio < 1:
            raise ConfigError("weak_ratio", self.weak_ratio, "0 (never weak) to below 1")

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return points and depth, one of which is needed; odometry is used when present."""
        return (frozenset({Sensor.POINTS}), frozenset({Sensor.DEPTH}))

    @abstractmethod
    def make_map(self, voxel_m: float, reader: CloudReader) -> CloudMap:
        """Return an empty map of the library, for the clouds of `reader`."""

    def activate(self, rig: Rig) -> None:
        """Start a session with the lidar or, without one, with the depth camera."""
        self._reader = CloudReader(
            rig, depth_range_max_m=self.depth_range_max_m, depth_stride_px=self.depth_stride_px
        )
        range_max_m = self._reader.range_m[1]
        derived_m = _DEPTH_VOXEL_M if self._reader.is_depth else range_max_m / 100.0
        voxel_m = self.voxel_m or derived_m
        self._icp = self.make_map(voxel_m, self._reader)
        self._speed_max_m_s = self.speed_max_m_s or 0.5 * range_max_m
        self._noise_m = self.noise_m or 0.2 * voxel_m
        self._predictor = Predictor(rig)
        self._has_map, self._has_moved, self._interval_s = False, False, _INTERVAL_S

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m] at the observation."""
        if self._reader is None or self._icp is None:
            raise RuntimeError("track() before activate()")
        prediction = self._predictor.predict(observation)
        self._icp.listen(observation)
        twist_s = self._predictor.model.inertia.velocity if self.deskew else None
        cloud = self._reader.read(observation, twist_s)
        if cloud is None:
            return self._predictor.bridged(observation, prediction, can_coast=self._has_map)
        if len(cloud) < _POINTS_MIN:
            return self._predictor.bridged(observation, prediction)
        self._icp.guess_off_m = self._first_off_m(observation, prediction)
        T_local_icp = self._icp.register(cloud, prediction.T_local_base, observation)
        if T_local_icp is None or not np.isfinite(T_local_icp).all():
            return self._predictor.bridged(observation, prediction)
        overlap_ratio, inliers = self._icp.overlap(T_local_icp)
        if self._has_map and not (
            overlap_ratio >= self.overlap_min_ratio
            and self._is_plausible(observation, prediction, T_local_icp)
            and (overlap_ratio >= _SAME_RATIO or self._is_near(cloud, observation, prediction))
        ):
            return self._predictor.bridged(observation, prediction, can_begin=True)
        shape = self._icp.localizability()
        T_local_base = self._fuse(observation, prediction, T_local_icp, shape)
        self._icp.accept(prediction.T_local_base, T_local_base)
        self._has_map = True
        is_open = shape.ratios[0] < self.weak_ratio
        status = TrackingStatus.DEGRADED if is_open else TrackingStatus.TRACKING
        return self._predictor.tracking(
            observation, T_local_base, status, quality_ratio=overlap_ratio, inliers=inliers
        )

    def get_map(self) -> MapLayers:
        """Return the voxel map in `local`, within the sensor's current range."""
        if self._icp is None:
            return MapLayers()
        return MapLayers(points=PointLayer(points=self._icp.points().astype(np.float32)))

    def shutdown(self) -> None:
        """Free the ray table; the map stays readable."""
        self._reader = None

    def _fuse(
        self,
        observation: Observation,
        prediction: Prediction,
        T_local_icp: se3.Transform,
        shape: Localizability,
    ) -> se3.Transform:
        """Return T_local_base (4, 4) [m] fused from odometry and ICP, weighted by covariances.

        Point-to-point registration underestimates motion along smooth planes. Without odometry its
        result is used, except for directions that the cloud's shape does not constrain: there the
        prediction is used.
        """
        information = shape.information(self._noise_m, self.weak_ratio)
        covariance = np.asarray(np.linalg.inv(np.linalg.inv(prediction.covariance) + information))
        if not self._has_map:
            self._predictor.measure(observation, T_local_icp, covariance)
            return T_local_icp
        is_known = prediction.is_measured
        predicted = prediction.covariance if is_known else _DIFFUSE * self._noise_m**2 * np.eye(6)
        gain = np.linalg.solve(np.linalg.inv(predicted) + information, information)
        off = se3.log(se3.inverse(prediction.T_local_base) @ T_local_icp)
        T_local_base = np.asarray(prediction.T_local_base @ se3.exp(gain @ off))
        held = shape.held(self.weak_ratio)
        step = np.repeat([_STEP_RATIO * self._noise_m, _STEP_RAD], 3)
        steps = held.T @ np.diag(step**-2.0) @ held
        interval_s = self._predictor.unmeasured_s(observation)
        self._interval_s += _SHARE * (interval_s - self._interval_s)
        self._predictor.measure(observation, T_local_base, covariance, steps)
        self._has_moved = True
        return T_local_base

    def _first_off_m(self, observation: Observation, prediction: Prediction) -> float:
        """Return how far [m] a lidar may be from its first pose; 0 once a motion was measured."""
        assert self._reader is not None
        if self._has_moved or prediction.is_measured or self._reader.is_depth:
            return 0.0
        fastest_m_s = min(_SIGMAS * float(FASTEST[0]), self._speed_max_m_s)
        return fastest_m_s * self._predictor.unmeasured_s(observation)

    def _is_near(self, cloud: Cloud, observation: Observation, prediction: Prediction) -> bool:
        """Tell whether no point may be taken for another, after a time without a pose."""
        unmeasured_s = self._predictor.unmeasured_s(observation)
        is_interrupted = self._predictor.is_long_unmeasured(observation)
        is_interrupted &= unmeasured_s > _INTERRUPTED * self._interval_s
        if prediction.is_measured or not is_interrupted:
            return True
        assert self._icp is not None
        moved_m, turned_rad = self._predictor.model.inertia.wandered(unmeasured_s)
        arm_m = np.median(np.linalg.norm(cloud, axis=1))
        off_m = _SIGMAS * np.hypot(moved_m, arm_m * turned_rad)
        return bool(off_m <= self._icp.capture_m)

    def _is_plausible(
        self, observation: Observation, prediction: Prediction, T_local_icp: se3.Transform
    ) -> bool:
        """Tell whether the motion since the last accepted cloud is plausible."""
        # With odometry, the difference to it has to be small.
        is_known = prediction.is_measured
        T_before = prediction.T_local_base if is_known else self._predictor.T_local_measured
        moved = se3.inverse(T_before) @ T_local_icp
        share = 0.2 if is_known else 1.0
        duration_s = max(self._predictor.unmeasured_s(observation), 0.02)
        return se3.is_within(
            moved,
            share * self._speed_max_m_s * duration_s + 0.05,
            share * self.turn_max_rad_s * duration_s + 0.05,
        )
