"""The `rko_lio` SLAM module: lidar-inertial odometry by RKO-LIO.

Malladi et al., "A Robust Approach for LiDAR-Inertial Odometry Without Sensor-Specific Modeling",
RA-L 2026. The library predicts and compensates motion by gyro and accelerometer, and aligns its
world with gravity; its motions between clouds are used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.deskew import valid_times_s
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_above, ranged
from sceneslam.types.rig import Sensor

from .cloud_map import CloudMap
from .cloud_odometry import CloudOdometry
from .clouds import Cloud, CloudReader
from .quiet import quiet


@dataclass(kw_only=True, eq=False)
class RkoLio(CloudOdometry):
    """Registers a lidar's clouds; the settings are described in `conf/slam/rko_lio.yaml`."""

    library: ClassVar[str | None] = "rko_lio"
    correspondence_max_m: float | None = ranged(check_above, 0)
    is_at_rest_first: bool
    depth_range_max_m: float = field(default=1.0, init=False)  # depth is not used
    depth_stride_px: int = field(default=1, init=False)

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the required sensors, all of which are needed."""
        return (frozenset({Sensor.POINTS, Sensor.GYRO, Sensor.ACCELEROMETER}),)

    def make_map(self, voxel_m: float, reader: CloudReader) -> CloudMap:
        """Return the library's map."""
        return _RkoMap(
            reader,
            voxel_m,
            deskew=self.deskew,
            max_correspondence_distance=self.correspondence_max_m or 0.5 * voxel_m,
            initialization_phase=self.is_at_rest_first,
        )


class _RkoMap(CloudMap):
    """The library, which adds every cloud to its own map at its own pose."""

    def __init__(self, reader: CloudReader, voxel_m: float, **settings: Any) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        near_m, far_m = reader.range_m
        super().__init__(voxel_m=voxel_m, range_max_m=far_m)
        self._T_base_lidar = reader.T_base_sensor
        common = {"voxel_size": voxel_m, "min_range": near_m, "max_range": far_m}
        # More threads change the order of sums.
        self._lio = LIO(LIOConfig(**common, **settings, max_num_threads=1))
        self._T_local_world: se3.Transform | None = None

    def listen(self, observation: Observation) -> None:
        """Add the IMU samples."""
        for after_s, rate, force in _inertial(observation):
            time_ns = observation.stamp_ns + round(after_s * 1e9)
            self._lio.add_imu_measurement(force, rate, time_ns, np.eye(4))

    def register(
        self, cloud: Cloud, T_local_guess: se3.Transform, observation: Observation
    ) -> se3.Transform | None:
        """Return T_local_base (4, 4) [m] by the observation's points and the IMU samples."""
        from rko_lio.rko_lio_pybind import InputError

        self.source = self.dense = cloud
        points = observation.points_lidar
        assert points is not None
        times_s = observation.point_times_s
        after_s = np.zeros(len(points)) if times_s is None else valid_times_s(times_s)
        stamps_ns = observation.stamp_ns + np.rint(after_s * 1e9).astype(np.int64)
        with quiet():  # it prints logs
            try:
                self._lio.register_scan(points, stamps_ns, self._T_base_lidar)
            except InputError:
                return None
        self._T_world_base = np.array(self._lio.pose(), np.float64)
        if self._T_local_world is None:
            self._T_local_world = T_local_guess @ se3.inverse(self._T_world_base)
        return self._T_local_world @ self._T_world_base

    def add(self, T_local_guess: se3.Transform, T_local_base: se3.Transform) -> None:
        """Continue from this pose."""
        self._T_local_world = T_local_base @ se3.inverse(self._T_world_base)

    def points(self) -> NDArray[Any]:
        """Return the map's points (N, 3) [m], local."""
        points_world = np.asarray(self._lio.map_point_cloud()).reshape(-1, 3)
        T_local_world = se3.identity() if self._T_local_world is None else self._T_local_world
        return np.asarray(se3.apply(T_local_world, points_world))


def _inertial(observation: Observation) -> list[tuple[float, NDArray[Any], NDArray[Any]]]:
    """Return (time after the stamp [s], rate (3,), force (3,)) at the gyro's samples."""
    gyro, force = observation.gyro_base, observation.accelerometer_base
    if gyro is None or force is None or not len(force):
        return []
    forces = [np.interp(gyro[:, 0], force[:, 0], force[:, axis]) for axis in (1, 2, 3)]
    return list(zip(gyro[:, 0].tolist(), gyro[:, 1:], np.stack(forces, axis=1), strict=True))
