"""The sensors of a robot, with intrinsics, extrinsics and noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.ranges import check_above, check_least
from sceneslam.types.se3 import Transform, identity

GRAVITY = 9.81  # m/s^2


class Sensor(Enum):
    """One kind of measurement that an observation can hold.

    The table of all sensors: name, field of `Observation`, words for messages, and whether it is
    sampled: then the field holds all samples since the observation before, (M, 4) rows of the time
    after the stamp [s] and three values along base's axes. A new sensor is a row here, its field,
    and the readers that know it.
    """

    IMAGE = "image", "image_bgr", "an image"
    DEPTH = "depth", "depth_m", "depth"
    SCAN = "scan", "scan", "a scan"
    POINTS = "points", "points_lidar", "lidar points"
    ODOMETRY = "odometry", "T_odom_base", "odometry"
    GYRO = "gyro", "gyro_base", "a gyro", True
    ACCELEROMETER = "accelerometer", "accelerometer_base", "an accelerometer", True

    field: str
    words: str
    is_sampled: bool

    def __new__(cls, name: str, field: str, words: str, is_sampled: bool = False) -> Sensor:
        """Return the member of a row; its value is its name."""
        sensor = object.__new__(cls)
        sensor._value_ = name
        sensor.field, sensor.words, sensor.is_sampled = field, words, is_sampled
        return sensor


def optical_to_rep103() -> Transform:
    """Return T_base_cam of a camera that looks along base x (optical: x right, y down)."""
    return np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=float)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera; its depth, where it has one, is registered to its image."""

    size_wh: tuple[int, int]  # [px]
    fx: float  # [px]
    fy: float  # [px]
    cx: float  # [px], pixel centres at whole numbers
    cy: float  # [px]
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1 k2 p1 p2 k3 (OpenCV, plumb_bob)
    depth_range_m: tuple[float, float] = (0.3, 8.0)  # depths outside are missing
    T_base_cam: Transform = field(default_factory=optical_to_rep103)

    def __post_init__(self) -> None:
        _lock(self, "T_base_cam")

    @property
    def K(self) -> NDArray[np.float64]:
        """Return the (3, 3) intrinsic matrix [px]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def check_size(self, name: str, image: NDArray[Any], *channels: int) -> None:
        """Raise InputError if an image (H, W, *channels) has another size than the camera."""
        width, height = self.size_wh
        if image.shape != (height, width, *channels):
            raise InputError(f"{name}: expected {(height, width, *channels)}, got {image.shape}")

    def measures(self, depth_m: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (...) whether depths (...) [m] are valid: above 0, and within the range."""
        low_m, high_m = self.depth_range_m
        return np.asarray((depth_m > 0) & (depth_m >= low_m) & (depth_m <= high_m))  # NaN: false


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Laser:
    """A planar laser scanner; beams lie in the laser frame's xy plane."""

    T_base_laser: Transform = field(default_factory=identity)

    def __post_init__(self) -> None:
        _lock(self, "T_base_laser")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lidar:
    """A scanner that gives 3D points."""

    range_m: tuple[float, float] = (1.0, 100.0)
    T_base_lidar: Transform = field(default_factory=identity)

    def __post_init__(self) -> None:
        _lock(self, "T_base_lidar")


@dataclass(frozen=True, slots=True, kw_only=True)
class Wheels:
    """Standard deviations of wheel odometry, before its calibration."""

    noise_ratio: float = 0.07  # m after a metre, rad after a radian; it grows with the root of them
    drift_ratio: float = 0.02  # per metre and radian: systematic error
    drift_rad_per_m: float = 0.01
    axle_m: float = 0.0  # base is so far ahead of the axle, or behind; 0: exactly above it
    floor_m: float = 0.0005  # of any step: encoder resolution
    floor_rad: float = 0.0005

    def __post_init__(self) -> None:
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        check_least(0, axle_m=values.pop("axle_m"))
        check_above(0, **values)

    @classmethod
    def given(cls, noise: Mapping[str, float] | None) -> Wheels:
        """Return wheels of a configuration's `wheels`, None: the usual; ConfigError for others."""
        names = [each.name for each in fields(cls)]
        for name in noise or {}:
            if name not in names:
                raise ConfigError(f"wheels.{name}", (noise or {})[name], f"one of {names}")
        try:
            return cls(**(noise or {}))
        except ConfigError as error:
            raise error.under("wheels") from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Gyro:
    """A rate gyro's errors, as standard deviations."""

    bias_radps: float = 0.02  # before its calibration
    noise_rad: float = 3e-4  # of the turn between two observations, at least


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """The sensors of a source. `sensors` names what its observations can hold."""

    sensors: frozenset[Sensor]
    camera: Camera | None = None
    laser: Laser | None = None
    lidar: Lidar | None = None
    wheels: Wheels = Wheels()
    gyro: Gyro = Gyro()

    @property
    def odometry(self) -> Wheels | None:
        """Return the errors of the odometry, None without it."""
        return self.wheels if Sensor.ODOMETRY in self.sensors else None


def _lock(sensor: Camera | Laser | Lidar, name: str) -> None:
    """Replace a sensor's matrix by a read-only copy: all modules and sinks get the same rig."""
    matrix = np.array(getattr(sensor, name))
    matrix.flags.writeable = False
    object.__setattr__(sensor, name, matrix)
