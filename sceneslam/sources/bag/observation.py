"""Decoding of synchronised ROS messages into observations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.ros import decode
from sceneslam.ros.clouds import Cloud, PointTimes, cloud
from sceneslam.ros.pixels import DepthUnits, locked
from sceneslam.sources.bag.synchronise import Sample, SynchronisedSamples
from sceneslam.types.errors import InputError
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform

# There is one observation per message of the first available sensor of this list.
PRIMARY = (Sensor.IMAGE, Sensor.DEPTH, Sensor.POINTS, Sensor.SCAN, Sensor.ODOMETRY)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decoded:
    """An observation (None if no part of it could be decoded) and its decoding problems."""

    observation: Observation | None
    problems: tuple[str, ...]
    stamp_ns: int


class BundleDecoder:
    """Decodes synchronised samples; thread-safe."""

    def __init__(
        self,
        primary: Sensor,
        sensors: frozenset[Sensor],
        size_wh: tuple[int, int] | None,
        units: DepthUnits,
        *,
        is_live: bool = False,
    ) -> None:
        self._is_live = is_live
        self._primary = primary
        self._sensors = sensors
        self._size_wh = size_wh
        self._units = units
        self._has_depth = False  # True after the first depth image of the colour image's size

    def observe(self, bundle: SynchronisedSamples) -> Decoded:
        """Return the observation of the samples; an image of another size is treated as damaged.

        Raises InputError where the first depth image has another size than the image, if not live.
        """
        problems: list[str] = []
        stamp_ns = bundle.primary.stamp_ns
        scan, points = self._scan(bundle, problems), self._points(bundle, problems)
        samples: dict[str, Any] = {
            sensor.field: _samples(bundle, sensor) for sensor in bundle.samples
        }
        observation = Observation(
            stamp_ns=stamp_ns,
            image_bgr=self._image(bundle, problems),
            depth_m=self._depth(bundle, problems),
            scan=scan,
            points_lidar=None if points is None else points.points_lidar,
            point_times_s=None if points is None else points.point_times_s,
            T_odom_base=self._odometry(bundle),
            **samples,
        )
        is_empty = not any(observation.has(sensor) for sensor in self._sensors)
        return Decoded(
            observation=None if is_empty else observation,
            problems=tuple(problems),
            stamp_ns=stamp_ns,
        )

    def _sample(self, sensor: Sensor, bundle: SynchronisedSamples) -> Sample | None:
        others = {
            Sensor.DEPTH: bundle.depth,
            Sensor.SCAN: bundle.scan,
            Sensor.POINTS: bundle.points,
        }
        return bundle.primary if sensor is self._primary else others.get(sensor)

    def _image(self, bundle: SynchronisedSamples, problems: list[str]) -> NDArray[np.uint8] | None:
        sample = self._sample(Sensor.IMAGE, bundle)
        if sample is None:
            return None
        image = decode.image_bgr(sample.value)
        if image is None:
            problems.append("a colour image could not be decoded")
            return None
        return image if self._has_size("a colour image", image, problems) else None

    def _depth(
        self, bundle: SynchronisedSamples, problems: list[str]
    ) -> NDArray[np.float32] | None:
        sample = self._sample(Sensor.DEPTH, bundle)
        if sample is None:
            return None
        depth_m = decode.depth_m(sample.value, self._units)
        if depth_m is None:
            problems.append("a depth image could not be decoded")
            return None
        if not self._has_size("a depth image", depth_m, problems):
            if not self._is_live:
                self._refuse_first(sample.stamp_ns, depth_m)
            return None
        self._has_depth = True
        if decode.is_blank_depth(sample.value):
            problems.append("depth image without one finite value")
        return depth_m

    def _has_size(self, name: str, picture: NDArray[np.generic], problems: list[str]) -> bool:
        height, width = picture.shape[:2]
        if self._size_wh is None or (width, height) == self._size_wh:
            return True
        expected = f"{self._size_wh[0]}x{self._size_wh[1]}"
        problems.append(f"{name} was left out, it has {width}x{height} pixels, not {expected}")
        return False

    def _refuse_first(self, stamp_ns: int, depth_m: NDArray[np.float32]) -> None:
        """Raise InputError if no depth image so far had the colour image's size."""
        if not self._has_depth and self._size_wh is not None:
            height, width = depth_m.shape
            raise InputError(
                f"depth at stamp {stamp_ns * 1e-9:.6f} s: expected {self._size_wh[0]}x"
                f"{self._size_wh[1]} pixels as in the first image, got {width}x{height}"
            )

    def _scan(self, bundle: SynchronisedSamples, problems: list[str]) -> LaserScan | None:
        sample = self._sample(Sensor.SCAN, bundle)
        scan = None if sample is None else decode.scan(sample.value, sample.stamp_ns)
        if sample is not None and scan is None:
            problems.append(
                "a laser scan has no usable angles, or no range_max above its range_min"
            )
        return scan

    def _points(self, bundle: SynchronisedSamples, problems: list[str]) -> Cloud | None:
        sample = self._sample(Sensor.POINTS, bundle)
        if sample is None:
            return None
        found = cloud(sample.value, sample.stamp_ns)
        if found is None:
            problems.append("a point cloud is shorter than it says")
            return None
        if found.times is PointTimes.INVALID:
            problems.append(f"the times of a cloud's points are {found.times.value}")
        times_s, late_s = found.point_times_s, (sample.stamp_ns - bundle.primary.stamp_ns) * 1e-9
        if times_s is None and late_s != 0.0:
            times_s = np.zeros(len(found.points_lidar))
        if times_s is not None:
            times_s = locked(times_s + late_s)
        return replace(found, points_lidar=locked(found.points_lidar), point_times_s=times_s)

    def _odometry(self, bundle: SynchronisedSamples) -> NDArray[np.float64] | None:
        is_primary = self._primary is Sensor.ODOMETRY
        T_odom_base = bundle.primary.value if is_primary else bundle.T_odom_base
        return None if T_odom_base is None else locked(np.array(T_odom_base))


def _samples(bundle: SynchronisedSamples, sensor: Sensor) -> NDArray[np.float64] | None:
    """Return IMU samples (M, 4): time relative to the stamp [s], then x, y, z in base."""
    if not bundle.samples[sensor]:
        return None
    rows = [
        [(sample.stamp_ns - bundle.primary.stamp_ns) * 1e-9, *sample.value]
        for sample in bundle.samples[sensor]
    ]
    return locked(np.array(rows, dtype=np.float64))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mounts:
    """The poses on the robot by which measurements are brought into `base`."""

    T_base_imu: Transform  # (4, 4) [m]
    T_child_base: Transform  # (4, 4) [m]; child: the frame whose pose odometry reports


def measured(message: Any, sensor: Sensor, mounts: Mounts) -> Any:
    """Return a sensor's measurement in a decoded message, None if it is invalid.

    Odometry gives T_odom_base (4, 4) [m], an Imu the vector (3,) [rad/s or m/s^2] in base, any
    other type the message itself.
    """
    if sensor is Sensor.ODOMETRY:
        T_odom_child = decode.transform(message.pose.pose.position, message.pose.pose.orientation)
        return None if T_odom_child is None else T_odom_child @ mounts.T_child_base
    if sensor.is_sampled:
        held = decode.inertial(message).get(sensor)
        return None if held is None else mounts.T_base_imu[:3, :3] @ held
    return message
