"""Camera intrinsics from a configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneslam.types.errors import ConfigError

_NUMBERS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A pinhole camera and, if given, its distortion coefficients (OpenCV's order)."""

    fx: float  # [px]
    fy: float  # [px]
    cx: float  # [px]
    cy: float  # [px]
    distortion: tuple[float, ...] | None


def given_intrinsics(camera: Mapping[str, Any]) -> Intrinsics | None:
    """Return the intrinsics of `camera`: {fx, fy, cx, cy, distortion}; None if the four are null.

    Raises ConfigError for `camera.<key>` when a key is unknown, missing or out of range.
    """
    for key in camera:
        if key not in (*_NUMBERS, "distortion"):
            raise ConfigError(f"camera.{key}", camera[key], "fx, fy, cx, cy and distortion only")
    distortion = _distortion(camera.get("distortion"))
    values = {key: camera.get(key) for key in _NUMBERS}
    if all(value is None for value in values.values()):
        if distortion is not None:
            raise ConfigError("camera.fx", None, "a number [px], as camera.distortion is given")
        return None
    for key in sorted(values, key=lambda key: values[key] is None):  # keys with a value first
        value, least = values[key], 0 if key in ("fx", "fy") else -np.inf
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if value is None or not is_number or not least < value < np.inf:
            allowed = "a number above 0 [px]" if key in ("fx", "fy") else "a number [px]"
            raise ConfigError(
                f"camera.{key}", value, f"{allowed}, as another of fx fy cx cy is given"
            )
    numbers = {key: float(value) for key, value in values.items() if value is not None}
    return Intrinsics(**numbers, distortion=distortion)


def checked_range_m(key: str, range_m: object) -> tuple[float, float]:
    """Return [low, high] as a pair; raises ConfigError for `key` unless 0 <= low < high < inf."""
    allowed = "[low, high] with 0 <= low < high < inf [m]"
    if not isinstance(range_m, list | tuple) or len(range_m) != 2:
        raise ConfigError(key, range_m, allowed)
    low, high = range_m
    if not isinstance(low, int | float) or not isinstance(high, int | float):
        raise ConfigError(key, list(range_m), allowed)
    if not 0 <= low < high < math.inf:
        raise ConfigError(key, list(range_m), allowed)
    return float(low), float(high)


def given_range_m(key: str, range_m: object) -> tuple[float, float] | None:
    """Return the checked range, None when it is null."""
    return None if range_m is None else checked_range_m(key, range_m)


def checked_above_zero(key: str, value: float) -> float:
    """Return the value; raises ConfigError for `key` unless it is a number above 0."""
    if not np.isfinite(value) or value <= 0:
        raise ConfigError(key, value, "a number above 0")
    return float(value)


def _distortion(values: object) -> tuple[float, ...] | None:
    if values is None:
        return None
    allowed = "a list of 4, 5, 8, 12 or 14 numbers (k1 k2 p1 p2 k3 ...)"
    if not isinstance(values, list | tuple) or len(values) not in (4, 5, 8, 12, 14):
        raise ConfigError("camera.distortion", values, allowed)
    if not all(isinstance(value, int | float) and np.isfinite(value) for value in values):
        raise ConfigError("camera.distortion", list(values), allowed)
    numbers = tuple(float(value) for value in values)
    return numbers if len(numbers) > 4 else (*numbers, 0.0)
