"""Systematic errors of the turn, learnt: they add up however little they weigh."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation

# Deviations before anything is learnt: unequal wheels turn a robot with every metre, a wrong wheel
# base with every radian.
_PER_METRE_RAD, _PER_RADIAN = 0.05, 0.05
_DRIFT = 1e-3  # by which share of its start a deviation grows with each comparison: tyres wear
_OUTLIER = 3.0  # deviations: beyond, an error is none of these
_WINDOW_S = 0.5  # over which the gyro is compared with the wheels
_REST_RAD = 5e-4  # of a robot whose wheels stand still, over a window


@dataclass(slots=True)
class TurnErrors:
    """A Kalman filter of the turn's errors: wheels per metre, wheels per radian, gyro per second.

    Two of three witnesses at a time: a measured motion with wheels or gyro, or the gyro with the
    wheels (the bias of a gyro is what it says while the wheels stand still). About the level axes
    wheels say nothing unless they stand still.
    """

    gyro_bias_radps: float  # its standard deviation
    _start: NDArray[np.float64] = field(init=False)
    _errors: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3), init=False)
    _covariance: NDArray[np.float64] = field(init=False)
    _level_radps: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2), init=False)
    _rests: float = field(default=0.0, init=False)
    _window: _Window = field(default_factory=lambda: _Window(), init=False)

    def __post_init__(self) -> None:
        self._start = np.array([_PER_METRE_RAD, _PER_RADIAN, self.gyro_bias_radps])
        self._covariance = np.diag(self._start**2)

    @property
    def gyro_bias(self) -> NDArray[np.float64]:
        """Return the gyro's bias (3,) [rad/s], base axes, as far as it is known."""
        return np.array([*self._level_radps, -self._errors[2]])

    def of_wheels(self, distance_m: float, turn_rad: float) -> float:
        """Return what the wheels' turn misses [rad]."""
        return float(self._errors[0] * distance_m + self._errors[1] * turn_rad)

    def by_gyro(self, observation: Observation, duration_s: float) -> NDArray[np.float64] | None:
        """Return the rotation vector (3,) [rad] of the last `duration_s`, None without a gyro."""
        turn = observation.turn_by_gyro(duration_s)
        return None if turn is None else turn - self.gyro_bias * duration_s

    def learn(self, missed_rad: float, causes: NDArray[np.float64], variance: float) -> None:
        """Take in by how much a turn missed a measured one, and metres, radians, seconds of it."""
        spread, innovation = self._spread(causes, variance)
        limit = _OUTLIER * math.sqrt(innovation)
        self._update(min(max(missed_rad, -limit), limit), causes, spread / innovation)

    def compare(
        self,
        by_gyro: NDArray[np.float64],
        by_wheels_rad: float,
        *,
        causes: NDArray[np.float64],
        variance: float,
        duration_s: float,
    ) -> None:
        """Take in a turn of gyro and wheels; `causes` and `variance` are the wheels' error's."""
        window = self._window
        window.missed_rad += float(by_gyro[2]) - by_wheels_rad
        window.causes = window.causes + causes - np.array([0.0, 0.0, duration_s])
        window.variance += variance
        window.level_rad = window.level_rad + by_gyro[:2]
        window.duration_s += duration_s
        window.is_rest = window.is_rest and not causes.any()
        if window.duration_s < _WINDOW_S:
            return
        self._window = _Window()
        noise = _REST_RAD**2 if window.is_rest else window.variance
        spread, innovation = self._spread(window.causes, noise)
        if abs(window.missed_rad) > _OUTLIER * math.sqrt(innovation):
            return  # a wheel slips, or the robot is carried
        self._update(window.missed_rad, window.causes, spread / innovation)
        level = window.level_rad / window.duration_s
        if window.is_rest and np.abs(level).max() <= _OUTLIER * self.gyro_bias_radps:
            self._rests = min(self._rests + 1.0, 64.0)
            self._level_radps = self._level_radps + level / self._rests

    def _spread(
        self, causes: NDArray[np.float64], variance: float
    ) -> tuple[NDArray[np.float64], float]:
        self._covariance = self._covariance + np.diag((_DRIFT * self._start) ** 2)
        spread = self._covariance @ causes
        return spread, float(causes @ spread) + variance

    def _update(
        self, missed_rad: float, causes: NDArray[np.float64], gain: NDArray[np.float64]
    ) -> None:
        self._errors = self._errors + gain * missed_rad
        self._covariance = self._covariance - np.outer(gain, self._covariance @ causes)


@dataclass(slots=True)
class _Window:
    """What gyro and wheels said since they were last compared."""

    missed_rad: float = 0.0
    causes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    variance: float = 0.0
    level_rad: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    duration_s: float = 0.0
    is_rest: bool = True
