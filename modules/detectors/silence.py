"""Features for missing and frozen sensors, as durations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

Read = Callable[[Observation], Any]  # a measurement, None if the sensor is missing
_STILL_M, _STILL_RAD = 0.002, 0.002  # between two scans; less motion counts as standing still


@dataclass(slots=True)
class Silent:
    """Measures how long a sensor has had no valid measurement."""

    read: Read
    _last_ns: int | None = None

    def __call__(self, observation: Observation) -> float:
        """Return the time [s] since the last valid measurement, or since the first observation."""
        if self._last_ns is None or _is_usable(self.read(observation)):
            self._last_ns = observation.stamp_ns
        return (observation.stamp_ns - self._last_ns) * 1e-9


@dataclass(slots=True)
class Frozen:
    """Measures how long a sensor has repeated exactly the same measurement.

    Scans of low resolution may repeat while the robot stands still: with wheel odometry,
    `needs_motion` counts only the time of motion.
    """

    read: Read
    needs_motion: bool = False
    _value: Any = None
    _stamp_ns: int = 0
    _frozen_ns: int = 0
    _T_odom_base: Transform | None = None

    def __call__(self, observation: Observation) -> float:
        """Return the duration [s]; 0 as soon as the measurement changes."""
        value = self.read(observation)
        if value is None:
            return self._frozen_ns * 1e-9
        is_same = self._value is not None and np.array_equal(value, self._value, equal_nan=True)
        elapsed_ns = observation.stamp_ns - self._stamp_ns
        if not is_same:
            self._frozen_ns = 0
        elif self._is_moving(observation):
            self._frozen_ns += elapsed_ns
        self._value, self._stamp_ns = value, observation.stamp_ns
        self._T_odom_base = observation.T_odom_base
        return self._frozen_ns * 1e-9

    def _is_moving(self, observation: Observation) -> bool:
        T_before, T_now = self._T_odom_base, observation.T_odom_base
        if not self.needs_motion or T_before is None or T_now is None:
            return True
        T_prev_curr = se3.inverse(T_before) @ T_now
        moved_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
        return moved_m > _STILL_M or float(se3.rotation_angle_rad(T_prev_curr)) > _STILL_RAD


def _is_usable(value: Any) -> bool:
    """Tell whether a measurement has a finite value."""
    if value is None:
        return False
    array = np.asarray(value)
    return array.dtype == np.uint8 or not bool(np.isnan(array).all())
