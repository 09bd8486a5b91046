"""The base's velocity: what it predicts, and how well wheels agree with it.

A robot has inertia, so that its velocity continues: a Kalman filter with a random acceleration. How
well that predicts a motion is estimated on the way, since it depends on the robot, on the rate of
the sensors and on how exact their stamps are. So is how long a velocity lasts that nothing
measures: that of robots for 13 s (the wheels of Intel and ACES) to over a minute (MIT CSAIL), that
of a hand-held camera for 0.4 s (freiburg1_rpy) to 2.5 s (RedKitchen), by the autocorrelations of
`experiments/velocities.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.motion import BELIEVED, KEPT_S, Step, still
from sceneslam.motion.trust import NoiseRatio, evidence_of_a_lie
from sceneslam.types import se3
from sceneslam.types.covariance import UNKNOWN_VELOCITY, Matrix, updated

_ACCELERATION = np.array([1.5, 4.0])  # m/s^2, rad/s^2: largest usual of a robot
_USUAL = {False: 1.0, True: 1 / 3}  # of that: deviation of the acceleration, by: has wheels
_LASTS_S = 0.5, 20.0  # shortest and longest time constant of a velocity; it begins with the first
_CHANGED = np.array([0.1, 0.1]) ** 2  # (m/s)^2, (rad/s)^2: weight of that beginning
_JUMP = 3.0  # times the acceleration: a larger change of velocity is a jump
_STEP = np.array([1e-4, 1e-4])  # m, rad: least standard deviation of a predicted step
FASTEST = np.array([25.0, 20.0])  # m/s, rad/s: deviation of a velocity that was never measured
_UNUSED = 1e6  # m^2, rad^2: variance of what is not used
_MISSED = (0.05, 0.1)  # m, rad: standard deviation of a predicted motion before it is learnt


@dataclass(slots=True)
class Inertia:
    """Predicts the motion at constant velocity."""

    has_wheels: bool
    velocity: NDArray[np.float64] = field(default_factory=lambda: np.zeros(6), init=False)  # (6,)
    is_known: bool = field(default=False, init=False)  # else the velocity is 0
    _covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)), init=False)
    _unmeasured_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2), init=False)
    _changed: NDArray[np.float64] = field(default_factory=_CHANGED.copy, init=False)
    _lasted: NDArray[np.float64] = field(default_factory=lambda: _LASTS_S[0] * _CHANGED, init=False)
    _measured_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2), init=False)
    _missed: list[NoiseRatio] = field(
        default_factory=lambda: [NoiseRatio(missed) for missed in _MISSED], init=False
    )

    @property
    def missed(self) -> NDArray[np.float64]:
        """Return the estimated standard deviations (2,) [m, rad] of a predicted motion."""
        return np.array([noise.ratio for noise in self._missed])

    @property
    def _lasts_s(self) -> NDArray[np.float64]:
        """Return the time constants (2,) [s] of a velocity that nothing measures."""
        return np.clip(self._lasted / self._changed, *_LASTS_S)

    def _kept_s(self, duration_s: float) -> NDArray[np.float64]:
        """Return for how long (2,) [s] of a time the robot goes on at its velocity.

        In a gap as a first order Markov process does, in the mean, whose time constant is no longer
        than it was observed; a short time it goes on.
        """
        lasts_s = np.minimum(self._lasts_s, np.clip(self._measured_s, *_LASTS_S))
        kept_s = -lasts_s * np.expm1(-duration_s / lasts_s)
        return np.asarray(np.maximum(kept_s, min(duration_s, KEPT_S)))

    def reset(self) -> None:
        """Reset the velocity."""
        self.velocity, self._covariance = np.zeros(6), np.zeros((6, 6))
        self.is_known = False

    def predict(self, duration_s: float) -> Step:
        """Return the motion of the next `duration_s`."""
        before_s, self._unmeasured_s = self._unmeasured_s, self._unmeasured_s + duration_s
        variance = self._reach(self._unmeasured_s) ** 2 - self._reach(before_s) ** 2 + _STEP**2
        T_now_next = se3.exp(self.velocity * np.repeat(self._kept_s(duration_s), 3))
        return replace(still(), T=T_now_next, variance=variance)

    def wandered(self, duration_s: float) -> NDArray[np.float64]:
        """Return how far (2,) [m, rad] the robot may be from a prediction, as it has moved so far.

        The standard deviation of what a first order Markov process adds up to, from a known
        velocity on (Uhlenbeck and Ornstein, 1930). At first an unknown velocity counts as a second.
        """
        lasts_s = self._lasts_s
        square = (UNKNOWN_VELOCITY**2 + self._lasted) / (1.0 + self._measured_s)
        x = duration_s / lasts_s
        spread = 2.0 * x - 3.0 + 4.0 * np.exp(-x) - np.exp(-2.0 * x)
        return np.asarray(lasts_s * np.sqrt(square * np.maximum(spread, 0.0)))

    def evidence(self, wheels: Step, guess: Step, duration_s: float) -> NDArray[np.float64]:
        """Return the log-likelihood ratios (2,) of the wheels' motion: wheels wrong against right.

        Distance and turn, by what inertia predicts.
        """
        if not self.is_known:
            return np.zeros(2)
        off = se3.inverse(guess.T) @ wheels.T
        missed = np.array([off[0, 3], se3.yaw_rad(off)])
        changed = _USUAL[self.has_wheels] * _ACCELERATION * self._unmeasured_s * duration_s
        variance = self._known(duration_s) + changed**2 + wheels.variance + self.missed**2
        return evidence_of_a_lie(missed, variance, duration_s)

    def noise_of(
        self, wheels: Step, lying: NDArray[np.float64], duration_s: float
    ) -> NDArray[np.float64]:
        """Return the variances (2,) of the wheels' motion, wrong with the probabilities `lying`.

        Wheels that are not believed have no influence.
        """
        noise = self.missed**2 + wheels.variance
        wrong = (UNKNOWN_VELOCITY * duration_s) ** 2
        return np.where(lying < BELIEVED, noise + lying * wrong, _UNUSED)

    def learn(
        self, T_before_now: Matrix, covariance: Matrix, guess: Step, duration_s: float
    ) -> None:
        """Take a measured motion over `duration_s` with its covariance (6, 6), axes of `now`.

        `guess` is what was predicted. Components that were not measured fade.
        """
        off = se3.log(se3.inverse(guess.T) @ T_before_now)
        if self.is_known:
            variance = self._known(duration_s) + np.diag(covariance)[[0, 5]]
            for channel, axis in enumerate((0, 5)):
                self._missed[channel].learn(
                    float(off[axis]), 1.0, floor=0.0, variance=float(variance[channel]), share=1.0
                )
        self._filter(se3.log(T_before_now) / duration_s, covariance / duration_s**2, duration_s)

    def _filter(self, twist_s: NDArray[np.float64], covariance: Matrix, duration_s: float) -> None:
        """Take a measured velocity (6,) with its covariance (6, 6).

        In directions that it does not measure the velocity is a first order Markov process.
        """
        usual = np.diag(np.repeat(UNKNOWN_VELOCITY**2, 3))
        seen = usual @ np.linalg.inv(usual + covariance)
        unseen = np.eye(6) - seen
        is_measured = np.diag(seen).reshape(2, 3).min(axis=1) > 0.5
        self._unmeasured_s = np.where(is_measured, 0.0, self._unmeasured_s)
        before = kept = self.velocity
        if self.is_known:
            fading = np.repeat(1.0 - np.exp(-duration_s / self._lasts_s), 3)
            F = np.eye(6) - fading[:, None] * unseen
            changes = np.repeat((_USUAL[self.has_wheels] * _ACCELERATION * duration_s) ** 2, 3)
            kept, expected = F @ before, F @ self._covariance @ F.T + np.diag(changes)
        else:
            fastest = np.diag(np.repeat(FASTEST**2, 3))
            expected = seen @ fastest @ seen.T + unseen @ usual @ unseen.T
        gain = expected @ np.linalg.inv(expected + covariance)
        now = kept + gain @ (twist_s - kept)
        if self.has_wheels and self.is_known:  # else a jump cannot be detected
            reach = np.repeat(_JUMP * _ACCELERATION * duration_s, 3)
            now = before + np.clip(now - before, -reach, reach)
        if self.is_known:
            self._time(before, now, is_measured * duration_s)
        self.velocity = now
        self._covariance = updated(expected, gain, np.eye(6), covariance)
        self.is_known = True

    def _time(
        self, before: NDArray[np.float64], now: NDArray[np.float64], measured_s: NDArray[np.float64]
    ) -> None:
        """Add a change of velocity (6,) to what its time constants are estimated from.

        The change of a first order Markov process over dt has 2 dt / t times the process' variance.
        """
        lasting, changed = ((each.reshape(2, 3) ** 2).sum(axis=1) for each in (now, now - before))
        self._lasted = self._lasted + measured_s * lasting
        self._measured_s = self._measured_s + measured_s
        self._changed = self._changed + (measured_s > 0.0) * changed / 2.0

    def _known(self, duration_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances (2,) [m^2, rad^2] of a motion by that of the velocity."""
        return np.asarray(np.diag(self._covariance)[[0, 5]] * duration_s**2)

    def _reach(self, unmeasured_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the standard deviations (2,) [m, rad] of a prediction; they add up over time."""
        reach = UNKNOWN_VELOCITY * unmeasured_s
        if not self.is_known:
            return reach
        changed = (0.5 * _ACCELERATION * unmeasured_s**2) ** 2
        return np.minimum(reach, np.sqrt(self._known(unmeasured_s) + changed))
