"""Settings of the simulated sensors, with checks."""

from __future__ import annotations

import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.rig import Camera, Laser, optical_to_rep103

LIES = ("none", "reversed", "frozen", "slipping")

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSettings:
    """A colour camera with registered depth."""

    size_wh: tuple[int, int]
    fov_deg: float  # horizontal
    rate_hz: float
    depth_range_m: tuple[float, float]
    height_m: float
    forward_m: float
    tilt_deg: float  # downwards

    def __post_init__(self) -> None:
        _require(
            "size_wh", self.size_wh, "two sizes from 16 to 4096", _within(self.size_wh, 16, 4096)
        )
        _require("fov_deg", self.fov_deg, "20 to 120", 20 <= self.fov_deg <= 120)
        _require("rate_hz", self.rate_hz, "1 to 100", 1 <= self.rate_hz <= 100)
        near_m, far_m = self.depth_range_m
        _require("depth_range_m", self.depth_range_m, "0 <= near < far", 0 <= near_m < far_m)
        _require("height_m", self.height_m, "0.1 to 1.5", 0.1 <= self.height_m <= 1.5)
        _require("forward_m", self.forward_m, "-0.2 to 0.2", abs(self.forward_m) <= 0.2)
        _require("tilt_deg", self.tilt_deg, "-45 to 45", abs(self.tilt_deg) <= 45)

    def camera(self) -> Camera:
        """Return the camera model with its pose on the robot."""
        width, height = self.size_wh
        focal_px = 0.5 * width / np.tan(0.5 * np.deg2rad(self.fov_deg))
        tilt = se3.so3_exp(np.array([0.0, np.deg2rad(self.tilt_deg), 0.0]))
        position_m = np.array([self.forward_m, 0.0, self.height_m])
        return Camera(
            size_wh=self.size_wh,
            fx=float(focal_px),
            fy=float(focal_px),
            cx=0.5 * (width - 1),
            cy=0.5 * (height - 1),
            depth_range_m=self.depth_range_m,
            T_base_cam=se3.from_parts(tilt @ optical_to_rep103()[:3, :3], position_m),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserSettings:
    """A planar laser scanner."""

    fov_deg: float
    step_deg: float
    range_m: tuple[float, float]
    rate_hz: float
    noise_m: float
    height_m: float

    def __post_init__(self) -> None:
        _require("fov_deg", self.fov_deg, "10 to 360", 10 <= self.fov_deg <= 360)
        _require("step_deg", self.step_deg, "0.05 to 10", 0.05 <= self.step_deg <= 10)
        near_m, far_m = self.range_m
        _require("range_m", self.range_m, "0 <= near < far", 0 <= near_m < far_m)
        _require("rate_hz", self.rate_hz, "1 to 50", 1 <= self.rate_hz <= 50)
        _require("noise_m", self.noise_m, "0 to 1", 0 <= self.noise_m <= 1)
        _require("height_m", self.height_m, "0.02 to 1.5", 0.02 <= self.height_m <= 1.5)

    def laser(self) -> Laser:
        """Return the laser model with its pose on the robot."""
        position_m = np.array([0.0, 0.0, self.height_m])
        return Laser(T_base_laser=se3.from_parts(np.eye(3), position_m))

    def angles_rad(self) -> NDArray[np.float64]:
        """Return the beams' angles (beams,) [rad], counter-clockwise, symmetric to x of `laser`."""
        half = int(0.5 * self.fov_deg / self.step_deg + 1e-6)
        return np.asarray(np.deg2rad(self.step_deg) * np.arange(-half, half + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometrySettings:
    """Wheel encoders: two wheels with their errors, and slip."""

    wheel_base_m: float
    scale_error_ratio: float  # of both wheels
    unequal_ratio: float  # scale difference between the wheels
    noise_ratio: float  # standard deviation per wheel, per square root of a metre
    slips_per_minute: float
    slip_m: float  # largest slip of one or both wheels
    lie: str  # kind of temporary encoder failure
    lies_per_minute: float  # at least one
    lie_s: float  # duration of each

    def __post_init__(self) -> None:
        _require("wheel_base_m", self.wheel_base_m, "0.05 to 1", 0.05 <= self.wheel_base_m <= 1)
        for name in ("scale_error_ratio", "unequal_ratio"):
            value = getattr(self, name)
            _require(name, value, "-0.2 to 0.2", abs(value) <= 0.2)
        _require("noise_ratio", self.noise_ratio, "0 to 0.2", 0 <= self.noise_ratio <= 0.2)
        _require(
            "slips_per_minute", self.slips_per_minute, "0 to 600", 0 <= self.slips_per_minute <= 600
        )
        _require("slip_m", self.slip_m, "0 to 1", 0 <= self.slip_m <= 1)
        _require("lie", self.lie, f"one of {', '.join(LIES)}", self.lie in LIES)
        _require(
            "lies_per_minute", self.lies_per_minute, "0 to 60", 0 <= self.lies_per_minute <= 60
        )
        _require("lie_s", self.lie_s, "0.1 to 60", 0.1 <= self.lie_s <= 60)


@dataclass(frozen=True, slots=True, kw_only=True)
class GyroSettings:
    """A rate gyro."""

    rate_hz: float
    bias_radps: float  # standard deviation between seeds, per axis
    noise_radps: float  # per sample
    bias_walk_radps_per_sqrt_s: float  # random walk of the bias

    def __post_init__(self) -> None:
        _require("rate_hz", self.rate_hz, "10 to 1000", 10 <= self.rate_hz <= 1000)
        _require("bias_radps", self.bias_radps, "0 to 1", 0 <= self.bias_radps <= 1)
        _require("noise_radps", self.noise_radps, "0 to 1", 0 <= self.noise_radps <= 1)
        walk = self.bias_walk_radps_per_sqrt_s
        _require("bias_walk_radps_per_sqrt_s", walk, "0 to 0.1", 0 <= walk <= 0.1)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExposureSettings:
    """Exposure of the camera: automatic, or `nominal_s` without gain."""

    is_automatic: bool
    target_grey: float  # target mean of the image
    lag_s: float  # time constant
    nominal_s: float  # time at which white in unit light is white in the image
    range_s: tuple[float, float]
    gain_max: float  # used beyond the longest exposure time

    def __post_init__(self) -> None:
        _require("target_grey", self.target_grey, "20 to 235", 20 <= self.target_grey <= 235)
        _require("lag_s", self.lag_s, "0.01 to 10", 0.01 <= self.lag_s <= 10)
        _require("nominal_s", self.nominal_s, "0.0001 to 1", 1e-4 <= self.nominal_s <= 1)
        least_s, most_s = self.range_s
        _require("range_s", self.range_s, "0 < least < most <= 1", 0 < least_s < most_s <= 1)
        _require("gain_max", self.gain_max, "0.1 to 64", 0.1 <= self.gain_max <= 64)


def read(kind: type[_T], key: str, values: Mapping[str, Any]) -> _T:
    """Return the settings of a mapping; raises ConfigError that names the wrong key."""
    names = [entry.name for entry in fields(kind)]  # type: ignore[arg-type]
    for name in values:
        if name not in names:
            raise ConfigError(f"{key}.{name}", values[name], f"one of {', '.join(names)}")
    for name in names:
        if name not in values:
            raise ConfigError(f"{key}.{name}", None, "a value")
    for entry in fields(kind):  # type: ignore[arg-type]
        value = values[entry.name]
        fits, allowed = _KINDS[str(entry.type).partition("[")[0]]
        if not fits(value):
            raise ConfigError(f"{key}.{entry.name}", value, allowed)
    plain = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
    try:
        return kind(**plain)
    except ConfigError as err:
        raise err.under(key) from None


def _is_pair(value: object) -> bool:
    is_list = isinstance(value, list | tuple) and len(value) == 2
    return is_list and all(map(_is_number, typing.cast("Sequence[object]", value)))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_KINDS: Mapping[str, tuple[Callable[[object], bool], str]] = {  # type -> its check, what it allows
    "tuple": (_is_pair, "a list of two numbers"),
    "float": (_is_number, "a number"),
    "bool": (lambda value: isinstance(value, bool), "true or false"),
    "str": (lambda value: isinstance(value, str), "a word"),
}


def _require(name: str, value: object, allowed: str, is_met: bool) -> None:
    if not is_met:
        raise ConfigError(name, value, allowed)


def _within(values: tuple[int, int], low: int, high: int) -> bool:
    return len(values) == 2 and all(isinstance(v, int) and low <= v <= high for v in values)
