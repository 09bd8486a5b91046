"""The `kiss_icp` SLAM module: an adapter over KISS-ICP, for lidars and depth cameras.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023. The library registers and
keeps the voxel map; deskewing, prediction and judgement are here: it takes empty clouds and NaN
in silence, and stops the process where all stamps are equal or a rotation is off by 1e-10.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import MapLayers, PointLayer
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory

from .clouds import CloudReader
from .degeneracy import Localizability
from .icp_map import IcpMap

_POINTS_MIN = 50  # fewer do not hold six degrees of freedom
_COAST_S = 0.5  # without a good cloud for longer, a guessed pose is no pose
_DEPTH_VOXEL_M = 0.1
_POSITIVE = (
    "voxel_m initial_threshold_m motion_min_m points_per_voxel iterations_max "
    "depth_range_max_m depth_stride_px noise_m noise_rad odometry_noise_ratio "
    "speed_max_m_s turn_max_rad_s"
)
_STEP_DEVIATION = np.array([2e-4, 2e-4])  # m, rad: floor of odometry's per step
_JERKED = np.array([3.0, 3.0])  # m/s^2, rad/s^2: how fast an unmeasured velocity changes
_DIFFUSE = 1e6  # variances of a cloud: a prediction that ICP alone decides against


@dataclass(kw_only=True, eq=False)
class KissIcp:
    """Registers 3D clouds; `conf/slam/kiss_icp.yaml` says what the settings are."""

    voxel_m: float | None
    initial_threshold_m: float | None
    motion_min_m: float | None
    points_per_voxel: int
    iterations_max: int
    depth_range_max_m: float
    depth_stride_px: int
    deskew: bool
    noise_m: float | None
    noise_rad: float
    odometry_noise_ratio: float
    overlap_min_ratio: float
    weak_ratio: float
    speed_max_m_s: float | None
    turn_max_rad_s: float
    _reader: CloudReader | None = field(default=None, init=False)
    _icp: IcpMap | None = field(default=None, init=False)
    _T_map_local: se3.Transform = field(default_factory=se3.identity, init=False)
    _T_local_base: se3.Transform = field(default_factory=se3.identity, init=False)

    def __post_init__(self) -> None:
        """Check the settings."""
        for name in _POSITIVE.split():
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ConfigError(name, value, "above 0")
        if not 0 <= self.overlap_min_ratio <= 1:
            raise ConfigError("overlap_min_ratio", self.overlap_min_ratio, "0 to 1")
        if not 0 <= self.weak_ratio < 1:
            raise ConfigError("weak_ratio", self.weak_ratio, "0 (never weak) to below 1")

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sensors, one of which suffices; odometry is used when present."""
        return (frozenset({Sensor.POINTS}), frozenset({Sensor.DEPTH}))

    def activate(self, rig: Rig) -> None:
        """Start anew, with the lidar where there is one, else with the depth camera."""
        self._reader = CloudReader(
            rig, depth_range_max_m=self.depth_range_max_m, depth_stride_px=self.depth_stride_px
        )
        range_max_m = self._reader.range_m[1]
        derived_m = _DEPTH_VOXEL_M if self._reader.is_depth else range_max_m / 100.0
        voxel_m = self.voxel_m or derived_m
        self._icp = IcpMap(
            voxel_m=voxel_m,
            initial_threshold_m=self.initial_threshold_m or 2.0 * voxel_m,
            motion_min_m=self.motion_min_m or (0.3 if self._reader.is_depth else 0.1) * voxel_m,
            range_max_m=range_max_m,
            points_per_voxel=self.points_per_voxel,
            iterations_max=self.iterations_max,
        )
        self._speed_max_m_s = self.speed_max_m_s or 0.5 * range_max_m
        noise = np.array([self.noise_m or 0.2 * voxel_m, self.noise_rad]) ** 2
        self._noise = np.repeat(noise, 3)  # variances of a registration
        self._covariance = 1e-8 * np.eye(6)  # of the pose in base, beside the map around
        self._T_map_local, self._T_local_base = se3.identity(), se3.identity()
        self._T_local_held = se3.identity()  # by the latest good cloud
        self._held_ns: int | None = None
        self._twist_s = np.zeros(6)  # base's motion per second
        self._stamp_ns: int | None = None
        self._T_odom_prev: se3.Transform | None = None
        self._is_measured = True  # all motion since the latest good cloud is odometry's

    def set_pose(self, T_map_local: se3.Transform) -> None:
        """Place `local` in the map."""
        self._T_map_local = np.array(T_map_local, dtype=np.float64)

    def set_scene(self, scene: str) -> None:
        """Do nothing: geometry is the same by day and by night."""

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base at the observation."""
        if self._reader is None or self._icp is None:
            raise RuntimeError("track() before activate()")
        T_local_guess = se3.orthonormal(self._T_local_base @ self._predict(observation))
        twist_s = self._twist_s if self.deskew else np.zeros(6)
        cloud = self._reader.read_unswept(observation, twist_s)
        if cloud is None:
            return self._bridge(observation, T_local_guess, can_coast=True)
        if len(cloud) < _POINTS_MIN:
            return self._bridge(observation, T_local_guess, can_coast=False)
        T_local_base = self._icp.register(cloud, T_local_guess)
        overlap_ratio, inliers = self._icp.overlap(T_local_base)
        if self._held_ns is not None and not (
            overlap_ratio >= self.overlap_min_ratio
            and self._is_plausible(observation.stamp_ns, T_local_guess, T_local_base)
        ):
            return self._bridge(observation, T_local_guess, can_coast=False)
        shape = self._icp.localizability()
        T_local_base = self._fuse(T_local_guess, T_local_base, shape)
        self._icp.accept(T_local_guess, T_local_base)
        self._hold(observation.stamp_ns, T_local_base)
        is_open = shape.ratios[0] < self.weak_ratio
        status = TrackingStatus.DEGRADED if is_open else TrackingStatus.TRACKING
        return self._answer(observation, status, overlap_ratio, inliers)

    def get_pose(self) -> se3.Transform:
        """Return T_map_base of the last observation."""
        return self._T_map_local @ self._T_local_base

    def get_trajectory(self) -> Trajectory:
        """Return no poses: ICP against a map that moves along revises nothing."""
        return Trajectory.empty()

    def get_map(self) -> MapLayers:
        """Return the voxel map in `local`: what lies within the sensor's range by now."""
        if self._icp is None:
            return MapLayers()
        return MapLayers(points=PointLayer(points=self._icp.points().astype(np.float32)))

    def shutdown(self) -> None:
        """Free the ray table; the map stays."""
        self._reader = None

    def _predict(self, observation: Observation) -> se3.Transform:
        """Return the motion since the last observation: odometry's, else on as before."""
        before_ns, T_odom_prev = self._stamp_ns, self._T_odom_prev
        T_odom_base = observation.T_odom_base
        if T_odom_base is not None and not np.isfinite(T_odom_base).all():
            T_odom_base = None
        self._stamp_ns, self._T_odom_prev = observation.stamp_ns, T_odom_base
        if before_ns is None:
            self._is_measured = T_odom_base is not None
            return se3.identity()
        if T_odom_base is not None and T_odom_prev is not None:
            T_prev_curr = se3.inverse(T_odom_prev) @ T_odom_base
            moved = float(np.linalg.norm(T_prev_curr[:3, 3]))
            # A wheel's error per metre turns as many radians.
            turned = float(se3.rotation_angle_rad(T_prev_curr)) + moved
            deviation = self.odometry_noise_ratio * np.array([moved, turned]) + _STEP_DEVIATION
        else:
            gap_s = (observation.stamp_ns - before_ns) * 1e-9
            self._is_measured = False
            T_prev_curr = se3.exp(self._twist_s * gap_s)
            deviation = 0.5 * _JERKED * gap_s**2 + _STEP_DEVIATION
        carry = se3.adjoint(se3.inverse(T_prev_curr))
        grown = np.diag(np.repeat(deviation**2, 3))
        self._covariance = carry @ self._covariance @ carry.T + grown
        return T_prev_curr

    def _fuse(
        self, T_local_guess: se3.Transform, T_local_icp: se3.Transform, shape: Localizability
    ) -> se3.Transform:
        """Return the pose between odometry's and ICP's, by the doubt in each.

        Point-to-point registration drags along smooth planes. Without odometry its answer stands,
        but for the directions that the cloud's shape leaves open: there the prediction does.
        """
        held, predicted = shape.held(self.weak_ratio), self._covariance
        information = held.T @ np.diag(1.0 / self._noise) @ held
        fused = np.linalg.inv(np.linalg.inv(predicted) + information)
        self._covariance = np.asarray(fused, np.float64)
        if self._held_ns is None:
            return T_local_icp
        if not self._is_measured:
            predicted = _DIFFUSE * np.diag(self._noise)
        gain = np.linalg.solve(np.linalg.inv(predicted) + information, information)
        off = se3.log(se3.inverse(T_local_guess) @ T_local_icp)
        return np.asarray(T_local_guess @ se3.exp(gain @ off))

    def _is_plausible(
        self, stamp_ns: int, T_local_guess: se3.Transform, T_local_base: se3.Transform
    ) -> bool:
        """Tell whether a robot can have moved so, in the time since the last good cloud."""
        if not np.isfinite(T_local_base).all():
            return False
        # Of a motion that odometry knows, the difference has to be small.
        T_before = T_local_guess if self._is_measured else self._T_local_held
        moved = se3.inverse(T_before) @ T_local_base
        share = 0.2 if self._is_measured else 1.0
        duration_s = max((stamp_ns - (self._held_ns or 0)) * 1e-9, 0.02)
        return bool(
            np.linalg.norm(moved[:3, 3]) <= share * self._speed_max_m_s * duration_s + 0.05
            and se3.rotation_angle_rad(moved) <= share * self.turn_max_rad_s * duration_s + 0.05
        )

    def _hold(self, stamp_ns: int, T_local_base: se3.Transform) -> None:
        if self._held_ns is not None and stamp_ns > self._held_ns:
            duration_s = (stamp_ns - self._held_ns) * 1e-9
            self._twist_s = se3.log(se3.inverse(self._T_local_held) @ T_local_base) / duration_s
        self._T_local_base = self._T_local_held = T_local_base
        self._held_ns, self._is_measured = stamp_ns, True

    def _bridge(
        self, observation: Observation, T_local_guess: se3.Transform, *, can_coast: bool
    ) -> Tracking:
        """Go on without a cloud: by odometry, for a moment as before, else not at all."""
        if self._is_measured:
            self._T_local_base = T_local_guess
            return self._answer(observation, TrackingStatus.DEGRADED, 0.0, 0)
        since_ns = observation.stamp_ns - (self._held_ns or 0)
        if can_coast and self._held_ns is not None and since_ns <= _COAST_S * 1e9:
            self._T_local_base = T_local_guess
            return self._answer(observation, TrackingStatus.TRACKING, 0.0, 0)
        self._T_local_base, self._twist_s = self._T_local_held, np.zeros(6)
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
