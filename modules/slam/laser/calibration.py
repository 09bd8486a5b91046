"""What the turn of odometry or gyro is off by, learned from the poses that scans hold."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_START = np.array([0.05, 0.05, 0.02])  # deviation: rad per m driven, per rad turned, per s
_DRIFT = (
    1e-3  # by which share of its start a deviation grows with each scan: wheels wear, gyros warm
)
_NOISE_RAD = 0.004  # of one scan's turn against that of the scan before


@dataclass(slots=True)
class TurnCalibration:
    """Recursive least squares of the turn's error over distance, turn and time.

    Unequal wheels turn a robot with every metre, and a gyro's bias with every second. Left in the
    prediction, such an error is not noise: it adds up however little the prediction weighs.
    """

    _errors: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3), init=False)
    _covariance: NDArray[np.float64] = field(default_factory=lambda: np.diag(_START**2), init=False)
    _since: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3), init=False)

    def correct(self, turn_rad: float, *, distance_m: float, duration_s: float) -> float:
        """Return a measured turn without its error, and remember what it was made of."""
        causes = np.array([distance_m, turn_rad, duration_s])
        self._since = self._since + causes
        return turn_rad + float(causes @ self._errors)

    def learn(self, missed_rad: float, deviation_rad: float) -> None:
        """Take in how much more the robot turned since the last call than was predicted."""
        causes, self._since = self._since, np.zeros(3)
        self._covariance = self._covariance + np.diag((_DRIFT * _START) ** 2)
        spread = self._covariance @ causes
        noise = _NOISE_RAD**2 + deviation_rad**2
        gain = spread / (causes @ spread + noise)
        limit = 3.0 * float(np.sqrt(causes @ spread + noise))  # an outlier teaches little
        self._errors = self._errors + gain * float(np.clip(missed_rad, -limit, limit))
        self._covariance = self._covariance - np.outer(gain, spread)

    def forget(self) -> None:
        """Drop what was driven since the last call to `learn`: its turn is not known."""
        self._since = np.zeros(3)
