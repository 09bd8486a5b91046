"""The `laser` SLAM module: its settings, life cycle and map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.model import MotionModel
from sceneslam.scans.depth_scan import DepthScanner
from sceneslam.scans.deskew import deskewed
from sceneslam.scans.lidar_scan import LidarScanner
from sceneslam.scans.occupancy_grid import scan_layer
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import LaserScan, Observation, Tracking
from sceneslam.types.planar import to_transform
from sceneslam.types.ranges import Checked, check_above, check_between, check_least, ranged
from sceneslam.types.rig import Rig, Sensor

from ..local import LocalModule
from .frontend import FrontEnd
from .keyframes import ScanKeyframes
from .matcher import Matcher
from .relocalizer import ScanRelocalizer
from .surface import ScanSurfaceReader


@dataclass(kw_only=True, eq=False)
class LaserSlam(LocalModule, Checked):
    """2D SLAM from a laser, or from a lidar or depth image converted to a scan: x, y, yaw.

    The fields are the settings; `conf/slam/laser.yaml` describes each one.
    """

    resolution_m: float = ranged(check_above, 0)
    range_max_m: float = ranged(check_above, 0)
    laser_noise_m: float = ranged(check_above, 0)
    depth_noise_m: float = ranged(check_above, 0)
    depth_noise_per_m: float = ranged(check_least, 0)
    depth_shift_m: float = ranged(check_least, 0)
    beams_min: int = ranged(check_least, 1)
    inlier_min_ratio: float = ranged(check_between, 0, 1)
    window_m: float = ranged(check_above, 0)
    window_rad: float = ranged(check_above, 0)
    degeneracy_ratio: float = ranged(check_between, 0, 1)
    keyframe_distance_m: float = ranged(check_above, 0)
    keyframe_angle_rad: float = ranged(check_above, 0)
    submap_keyframes: int = ranged(check_least, 1)
    predict_max_s: float = ranged(check_least, 0)
    height_min_m: float | None
    height_max_m: float | None
    depth_beams: int = ranged(check_least, 1)
    depth_stride_px: int = ranged(check_least, 1)
    lidar_beams: int = ranged(check_least, 1)
    deskew: bool
    _scanner: DepthScanner | LidarScanner | None = field(default=None, init=False)
    _front_end: FrontEnd | None = field(default=None, init=False)
    _T_base_laser: se3.Transform = field(default_factory=se3.identity, init=False)
    _T_base_lidar: se3.Transform = field(default_factory=se3.identity, init=False)
    _velocity: NDArray[np.float64] | None = field(default=None, init=False)  # at the last cloud

    def __post_init__(self) -> None:
        """Check the settings."""
        super().__post_init__()
        low_m, high_m = self.height_min_m, self.height_max_m
        if low_m is not None and high_m is not None and not low_m < high_m:
            raise ConfigError("height_max_m", high_m, f"above height_min_m ({low_m:g} m)")

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sensors, of which one suffices; odometry and gyro are used if present."""
        return (
            frozenset({Sensor.SCAN}),
            frozenset({Sensor.POINTS}),
            frozenset({Sensor.DEPTH}),
        )

    def activate(self, rig: Rig) -> None:
        """Start with an empty map: by the laser if present, else a lidar's slice, else depth."""
        self._scanner = self._make_scanner(rig)
        if self._scanner is not None:
            self._T_base_laser = self._scanner.T_base_laser
        else:
            self._T_base_laser = se3.identity() if rig.laser is None else rig.laser.T_base_laser
        self._front_end, self._velocity = self._make_front_end(rig), None

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base at the observation."""
        if self._front_end is None:
            raise RuntimeError("track() before activate()")
        return self._front_end.track(observation, self._scan(observation))

    def get_map(self) -> MapLayers:
        """Return the scans of all keyframes, in `local`."""
        if self._front_end is None:
            return MapLayers()
        frames = self._front_end.keyframes.frames
        scans = scan_layer(
            [frame.scan for frame in frames],
            [to_transform(frame.T_local_base) @ self._T_base_laser for frame in frames],
            cell_m=self.resolution_m,
            range_max_m=self.range_max_m,
        )
        return MapLayers(scans=scans)

    def shutdown(self) -> None:
        """Free the depth tables; the map stays."""
        self._scanner = None

    def _scan(self, observation: Observation) -> LaserScan | None:
        stamp_ns = observation.stamp_ns
        if isinstance(self._scanner, LidarScanner) and observation.points_lidar is not None:
            return self._scanner.scan(self._points_lidar(observation), stamp_ns=stamp_ns)
        if isinstance(self._scanner, DepthScanner) and observation.depth_m is not None:
            return self._scanner.scan(observation.depth_m, stamp_ns=stamp_ns)
        return observation.scan

    def _points_lidar(self, observation: Observation) -> NDArray[np.floating]:
        """Return the cloud (N, 3) [m], lidar, as from the observation's instant."""
        assert observation.points_lidar is not None and self._front_end is not None
        if observation.point_times_s is None or not self.deskew:
            return observation.points_lidar
        # Poses say what the velocity is, and depend on it here: of one step alone, it would swing.
        before, inertia = self._velocity, self._front_end.motion.inertia
        self._velocity = inertia.velocity if inertia.is_known else None
        known = [velocity for velocity in (before, self._velocity) if velocity is not None]
        twist_s = np.mean(known, axis=0) if known else np.zeros(6)
        return deskewed(observation, self._T_base_lidar, twist_s)

    def _make_scanner(self, rig: Rig) -> DepthScanner | LidarScanner | None:
        if Sensor.SCAN in rig.sensors:
            return None
        if rig.lidar is not None and Sensor.POINTS in rig.sensors:
            self._T_base_lidar = rig.lidar.T_base_lidar
            return LidarScanner(
                rig.lidar,
                height_min_m=self.height_min_m,
                height_max_m=self.height_max_m,
                beams=self.lidar_beams,
            )
        if rig.camera is None:
            return None
        return DepthScanner(
            rig.camera,
            height_min_m=self.height_min_m,
            height_max_m=self.height_max_m,
            beams=self.depth_beams,
            stride_px=self.depth_stride_px,
        )

    def _make_front_end(self, rig: Rig) -> FrontEnd:
        from_depth = isinstance(self._scanner, DepthScanner)
        matcher = Matcher(
            window_m=self.window_m,
            window_rad=self.window_rad,
            degeneracy_ratio=self.degeneracy_ratio,
            shift_m=self.depth_shift_m if from_depth else 0.0,
        )
        reader = ScanSurfaceReader(
            T_base_laser=self._T_base_laser,
            range_max_m=self.range_max_m,
            noise_m=self.depth_noise_m if from_depth else self.laser_noise_m,
            noise_per_m=self.depth_noise_per_m if from_depth else 0.0,
        )
        return FrontEnd(
            resolution_m=self.resolution_m,
            beams_min=self.beams_min,
            inlier_min_ratio=self.inlier_min_ratio,
            predict_max_s=self.predict_max_s,
            matcher=matcher,
            relocalizer=ScanRelocalizer(matcher=matcher, reader=reader),
            motion=MotionModel(rig),
            reader=reader,
            keyframes=ScanKeyframes(
                keyframe_distance_m=self.keyframe_distance_m,
                keyframe_angle_rad=self.keyframe_angle_rad,
                submap_keyframes=self.submap_keyframes,
                reach_m=2.0 * self.range_max_m,
            ),
        )
