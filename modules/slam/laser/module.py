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
from sceneslam.types.rig import Rig, Sensor

from ..local import LocalModule
from .frontend import FrontEnd
from .keyframes import ScanKeyframes
from .matcher import Matcher
from .relocalizer import ScanRelocalizer
from .surface import ScanSurfaceReader

_ABOVE_0 = (
    "resolution_m range_max_m laser_noise_m depth_noise_m window_m window_rad "
    "keyframe_distance_m keyframe_angle_rad"
)
_NOT_BELOW_0 = "depth_noise_per_m depth_shift_m predict_max_s"
_AT_LEAST_1 = "beams_min submap_keyframes depth_beams depth_stride_px lidar_beams"
_RATIO = "inlier_min_ratio degeneracy_ratio"


@dataclass(kw_only=True, eq=False)
class LaserSlam(LocalModule):
    """2D SLAM from a laser, or from a lidar or depth image converted to a scan: x, y, yaw.

    The fields are the settings; `conf/slam/laser.yaml` describes each one.
    """

    resolution_m: float
    range_max_m: float
    laser_noise_m: float
    depth_noise_m: float
    depth_noise_per_m: float
    depth_shift_m: float
    beams_min: int
    inlier_min_ratio: float
    window_m: float
    window_rad: float
    degeneracy_ratio: float
    keyframe_distance_m: float
    keyframe_angle_rad: float
    submap_keyframes: int
    predict_max_s: float
    height_min_m: float | None
    height_max_m: float | None
    depth_beams: int
    depth_stride_px: int
    lidar_beams: int
    deskew: bool
    _scanner: DepthScanner | LidarScanner | None = field(default=None, init=False)
    _front_end: FrontEnd | None = field(default=None, init=False)
    _T_base_laser: se3.Transform = field(default_factory=se3.identity, init=False)
    _T_base_lidar: se3.Transform = field(default_factory=se3.identity, init=False)
    _velocity: NDArray[np.float64] | None = field(default=None, init=False)  # at the last cloud

    def __post_init__(self) -> None:
        """Check the settings."""
        for names, least, most, allowed in (
            (_ABOVE_0, 1e-9, np.inf, "above 0"),
            (_NOT_BELOW_0, 0.0, np.inf, "0 or more"),
            (_AT_LEAST_1, 1, np.inf, "1 or more"),
            (_RATIO, 0.0, 1.0, "0 to 1"),
        ):
            for name in names.split():
                if not least <= getattr(self, name) <= most:
                    raise ConfigError(name, getattr(self, name), allowed)
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
