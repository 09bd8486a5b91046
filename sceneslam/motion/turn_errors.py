"""Estimate the systematic errors of the turn, which accumulate even if they are small."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.distance_error import OUTLIER
from sceneslam.types.observation import Observation

# Standard deviations before the first measurement: unequal wheels cause an error per metre, a wrong
# wheel base an error per radian.
_PER_METRE_RAD, _PER_RADIAN = 0.05, 0.05
_DRIFT = 1e-3  # growth of a deviation per comparison, as a share of the first: tyres wear
_WINDOW_S = 0.5  # over which the gyro is compared with the wheels
_REST_RAD = 5e-4  # largest turn of a robot at rest, over a window
_RESTS_MAX = 64.0  # windows at rest over which the bias is averaged: 32 s


@dataclass(slots=True)
class TurnErrors:
    """A Kalman filter of the turn's errors: wheels per metre, wheels per radian, gyro per second.

    It compares a measured motion with wheels or gyro, or the gyro with the wheels (while the wheels
    stand still, the gyro measures its bias). About the horizontal axes wheels measure nothing
    unless they stand still.
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
        """Return the estimated gyro bias (3,) [rad/s], base axes."""
        return np.array([*self._level_radps, -self._errors[2]])

    @property
    def gyro_bias_deviation(self) -> float:
        """Return the standard deviation [rad/s] of the estimated bias about the vertical axis."""
        return math.sqrt(float(self._covariance[2, 2]))

    @property
    def knows_level_bias(self) -> bool:
        """Tell whether the bias about the horizontal axes was measured, at rest."""
        return self._rests > 0.0

    def of_wheels(self, distance_m: float, turn_rad: float) -> float:
        """Return the estimated error of the wheels' turn [rad]."""
        return float(self._errors[0] * distance_m + self._errors[1] * turn_rad)

    def by_gyro(self, observation: Observation, duration_s: float) -> NDArray[np.float64] | None:
        """Return the rotation vector (3,) [rad] of the last `duration_s`, None without a gyro."""
        turn = observation.turn_by_gyro(duration_s)
        return None if turn is None else turn - self.gyro_bias * duration_s

    def learn(self, missed_rad: float, causes: NDArray[np.float64], variance: float) -> None:
        """Update by the error of a turn against a measured one; `causes` (3,) [m, rad, s]."""
        spread, innovation = self._spread(causes, variance)
        limit = OUTLIER * math.sqrt(innovation)
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
        """Compare the turn by gyro (3,) [rad] with the wheels'.

        `causes` (3,) [m, rad, s] and `variance` [rad^2] are those of the wheels' error.
        """
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
        if abs(window.missed_rad) > OUTLIER * math.sqrt(innovation):
            return  # a wheel slips, or the robot is carried
        self._update(window.missed_rad, window.causes, spread / innovation)
        level = window.level_rad / window.duration_s
        if window.is_rest and np.abs(level).max() <= OUTLIER * self.gyro_bias_radps:
            self._rests = min(self._rests + 1.0, _RESTS_MAX)
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
    """Measurements of gyro and wheels since they were last compared."""

    missed_rad: float = 0.0
    causes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    variance: float = 0.0
    level_rad: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    duration_s: float = 0.0
    is_rest: bool = True
