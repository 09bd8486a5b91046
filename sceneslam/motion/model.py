"""The motion model: the base's motion from one observation to the next.

It uses wheel odometry, or else constant velocity, and replaces the turn of either by the gyro's
(Borenstein and Feng, "Gyrodometry", ICRA 1996). Systematic errors and noise of wheels and gyro are
estimated from motions that another sensor measured, and by comparing wheels and gyro; so is the
probability that the wheels are wrong now. Every user has its own model, so that a model that checks
a module is not calibrated by that module.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.distance_error import DistanceError
from sceneslam.motion.inertia import Inertia
from sceneslam.motion.motion import BELIEVED, Motion, Step, motion_of, still
from sceneslam.motion.trust import EVIDENCE_MAX, LieDetector, NoiseRatio, evidence_of_a_lie
from sceneslam.motion.turn_errors import TurnErrors
from sceneslam.types import se3
from sceneslam.types.covariance import UNKNOWN_VELOCITY, Matrix, updated
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform

_STILL_M, _STILL_RAD = 1e-5, 1e-5  # per step: less than one encoder tick
_AT_REST = 0.3  # share of the wheels' constant noise while the wheels stand still
_TURN_PER_METRE = 0.1  # base turns by a degree in a metre: wheels roll unevenly
_METRE_PER_TURN = 0.1  # base moves by 2 cm per radian in place: wheels slip sideways
_LATE_M, _SPEED_MAX_M_S = 1.0, 25.0  # odometry that moves farther was reset
_TAUGHT_MIN = 0.25  # least weight of wheels that are probably wrong, in estimating their noise
_WEAR = 1e-3  # change of the wheels' scale from one scan to the next, as a share of its deviation
_PLANAR = np.array([0, 1, 5])  # forward, left, yaw
# A motion is compared with that of the wheels once a lie of 0.1 m/s is five times its noise:
# the noise of two poses does not grow with the time between them.
_COMPARED_S, _SHOWN = (0.1, 0.3), 0.02  # least and longest interval; noise / UNKNOWN_VELOCITY


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A measured motion (4, 4) with its covariance (6, 6), and the wheels' motion."""

    duration_s: float
    T: Transform
    covariance: Matrix
    wheels: Step

    @property
    def missed(self) -> NDArray[np.float64]:
        """Return by how much the wheels differ (3,): forward, left [m], yaw [rad]."""
        return np.asarray(se3.log(se3.inverse(self.wheels.T) @ self.T)[_PLANAR])

    @property
    def evidence(self) -> NDArray[np.float64]:
        """Return the log-likelihood ratios (2,) of wheels that are wrong."""
        variance = self.wheels.variance + np.diag(self.covariance)[[0, 5]]
        return evidence_of_a_lie(self.missed[[0, 2]], variance, self.duration_s)

    @property
    def is_decisive(self) -> bool:
        """Tell whether the interval is long enough to tell wrong wheels from noise."""
        least_s, longest_s = _COMPARED_S
        if not least_s <= self.duration_s < longest_s:
            return self.duration_s >= longest_s
        noise = np.sqrt(np.diag(self.covariance)[[0, 5]])
        is_clear = (noise <= _SHOWN * UNKNOWN_VELOCITY * self.duration_s).all()
        return bool(is_clear or (self.evidence >= EVIDENCE_MAX).any())

    def then(self, later: Compared) -> Compared:
        """Return this motion followed by another; the errors of the pose between them cancel."""
        return Compared(
            self.duration_s + later.duration_s,
            self.T @ later.T,
            (self.covariance + later.covariance) / 2.0,
            self.wheels.then(later.wheels),
        )


class MotionModel:
    """Predicts the motion to one observation after the other; only `learn` calibrates it."""

    def __init__(self, rig: Rig) -> None:
        self._wheels, self._gyro = rig.wheels, rig.gyro
        self._floors = np.array([rig.wheels.floor_m, rig.wheels.floor_rad])
        self.inertia = Inertia(Sensor.ODOMETRY in rig.sensors)
        self._noise = [NoiseRatio(rig.wheels.noise_ratio) for _ in range(2)]  # distance, turn
        self._lies = [LieDetector() for _ in range(2)]
        self.turns = TurnErrors(rig.gyro.bias_radps)
        self._distance = DistanceError(rig.wheels.drift_ratio, drift=_WEAR * rig.wheels.drift_ratio)
        self._axle = DistanceError(rig.wheels.axle_m, drift=_WEAR * rig.wheels.axle_m)
        self._stamp_ns: int | None = None
        self.duration_s = 0.0  # between the last two observations
        self.is_turn_measured = False  # by the gyro, between them
        self._T_odom_base: Transform | None = None  # the last odometry
        self._silent_s = 0.0  # time since then
        self._gap: Transform | None = None  # predicted motion since then; None: no gap
        self._since_s = 0.0  # since the last measured motion
        self._since_wheels: Step | None = still()  # None: the wheels did not cover all of it
        self._since_guess = still()
        self._is_weighed = False  # the sensor weighs the sources itself, and may clear the wheels
        self._is_followed = True  # `stop` was not called since then
        self._compared: Compared | None = None  # too short so far to compare the wheels with

    @property
    def noise_ratios(self) -> NDArray[np.float64]:
        """Return the estimated standard deviations (2,) of wheels: after 1 m [m], 1 rad [rad]."""
        return np.array([noise.ratio for noise in self._noise])

    @property
    def lying(self) -> NDArray[np.float64]:
        """Return the probabilities (2,) that the wheels are wrong now: distance, turn."""
        return np.array([lie.lying for lie in self._lies])

    def predict(self, observation: Observation) -> Motion:
        """Return the motion from the last observation to this one, which becomes the last."""
        before_ns, self._stamp_ns = self._stamp_ns, observation.stamp_ns
        if before_ns is None:
            self._take_odometry(observation, 0.0)
            self._forget()
            return Motion(
                T_prev_curr=se3.identity(),
                covariance=np.zeros((6, 6)),
                is_measured=self._T_odom_base is not None,
            )
        duration_s = self.duration_s = max((observation.stamp_ns - before_ns) * 1e-9, 0.0)
        for lie in self._lies:
            lie.wait(duration_s)
        gap = self._gap
        wheels = self._take_odometry(observation, duration_s)
        guess = self.inertia.predict(duration_s)
        turn = self.turns.by_gyro(observation, duration_s)
        self.is_turn_measured = turn is not None
        if turn is not None:
            # What is left of the bias is the same in all steps since a measured motion.
            biased_s2 = (self._since_s + duration_s) ** 2 - self._since_s**2
            variance = self.turns.gyro_bias_deviation**2 * biased_s2 + self._gyro.noise_rad**2
            guess = guess.turned(turn, variance, duration_s)
            if wheels is not None and gap is None:
                self.turns.compare(
                    turn,
                    se3.yaw_rad(wheels.T),
                    causes=wheels.causes,
                    variance=float(wheels.variance[1]),
                    duration_s=duration_s,
                )
                wheels = wheels.turned(turn, variance, duration_s)
        if self._is_weighed and wheels is not None and gap is None:
            self._judge(self.inertia.evidence(wheels, guess, duration_s))
        self._since_s += duration_s
        self._since_guess = self._since_guess.then(guess)
        if wheels is not None and self._since_wheels is not None:
            self._since_wheels = self._since_wheels.then(wheels)
        if wheels is not None and gap is not None:  # motion in the gap was predicted already
            wheels = replace(wheels, T=se3.inverse(gap) @ wheels.T)
        motion = motion_of(
            wheels,
            guess,
            duration_s=duration_s,
            lying=self.lying,
            is_measured=wheels is not None and self._since_wheels is not None,
        )
        if self._gap is not None:
            self._gap = self._gap @ motion.T_prev_curr
        return motion

    def learn(
        self,
        T_before_now: Transform,
        covariance: NDArray[np.float64],
        evidence: NDArray[np.float64] | None = None,
    ) -> None:
        """Calibrate by the motion (4, 4) since the last call, as measured by another sensor alone.

        `covariance` (6, 6) is the measurement's alone, without any prediction: large in
        directions that the sensor did not measure. Axes of `now`. `evidence` (2,) of distance and
        turn is that of `Motion.evidence`; None: that of measured motions.
        """
        self._is_weighed = evidence is not None
        duration_s, guess = self._since_s, self._since_guess
        wheels = self._since_wheels if self._gap is None else None  # in a gap they are behind
        if duration_s <= 0.0 or not self._is_followed:  # the interval is unknown
            self.skip()
            return
        if evidence is not None:
            self._judge(evidence)
        self.inertia.learn(
            *self._with_wheels(T_before_now, covariance, wheels),
            guess=guess,
            duration_s=duration_s,
        )
        self._forget()
        if wheels is None:
            self._compare()
            return
        compared = Compared(duration_s, T_before_now, covariance, wheels)
        self._compared = compared if self._compared is None else self._compared.then(compared)
        if self._compared.is_decisive:
            self._compare()

    def _compare(self) -> None:
        """Calibrate the wheels by the motion that was measured since the last comparison."""
        compared, self._compared = self._compared, None
        if compared is None:
            return
        wheels = compared.wheels
        off, measured = compared.missed, compared.covariance[np.ix_(_PLANAR, _PLANAR)]
        if not self._is_weighed:
            self._judge(compared.evidence)
        for channel, axes in enumerate((slice(0, 2), slice(2, 3))):
            R = measured[axes, axes]
            for missed, variance in zip(off[axes].tolist(), np.diag(R).tolist(), strict=True):
                self._noise[channel].learn(
                    missed,
                    float(wheels.amounts[channel]),
                    floor=float(self._floors[channel]),
                    variance=variance,
                    share=max(1.0 - self._lies[channel].lying, _TAUGHT_MIN) / len(R),
                )
        if self._lies[0].lying < BELIEVED:
            self._distance.learn(
                float(off[0]), float(wheels.T[0, 3]), float(wheels.variance[0] + measured[0, 0])
            )
            self._axle.learn(
                float(off[1]), se3.yaw_rad(wheels.T), float(wheels.variance[0] + measured[1, 1])
            )
        if self._lies[1].lying < BELIEVED:
            self.turns.learn(
                float(off[2]), wheels.causes, float(wheels.variance[1] + measured[2, 2])
            )

    def _judge(self, evidence: NDArray[np.float64]) -> None:
        """Take the log-likelihood ratios (2,) of distance and turn, wheels wrong against right."""
        for lie, one in zip(self._lies, evidence.tolist(), strict=True):
            lie.judge(one)

    def _with_wheels(
        self, T_before_now: Transform, covariance: NDArray[np.float64], wheels: Step | None
    ) -> tuple[Transform, NDArray[np.float64]]:
        """Return a measured motion, completed by the wheels where it is weak."""
        if wheels is None:
            return T_before_now, covariance
        R = np.diag((self.inertia.noise_of(wheels, self.lying, self._since_s))[[0, 0, 1]])
        gain = covariance[:, _PLANAR] @ np.linalg.inv(covariance[np.ix_(_PLANAR, _PLANAR)] + R)
        off = se3.log(se3.inverse(T_before_now) @ wheels.T)[_PLANAR]
        return T_before_now @ se3.exp(gain @ off), updated(covariance, gain, np.eye(6)[_PLANAR], R)

    def skip(self) -> None:
        """Discard the motion since the last call, which no sensor measured."""
        self._forget()
        self._compare()
        self._is_followed = True

    def stop(self) -> None:
        """Reset velocity and odometry: the base is no longer tracked."""
        self.inertia.reset()
        self._forget()
        self._compare()
        self._since_wheels, self._is_followed = None, False

    def _forget(self) -> None:
        """Restart the comparison; odometry that is missing now has to restart, too."""
        if self._gap is not None:
            self._T_odom_base, self._gap = None, None
        self._since_s, self._since_wheels, self._since_guess = 0.0, still(), still()

    def _take_odometry(self, observation: Observation, duration_s: float) -> Step | None:
        """Return the motion since the last odometry, None if it is missing now or was before."""
        self._silent_s += duration_s
        T_before, T_odom_base = self._T_odom_base, observation.T_odom_base
        if T_odom_base is None:
            if T_before is None:
                self._since_wheels = None
            elif self._gap is None:
                self._gap = se3.identity()
            return None
        step = None
        if T_before is not None:
            step = self._by_wheels(se3.inverse(T_before) @ T_odom_base, self._silent_s)
        if step is None:
            self._since_wheels = None
        self._T_odom_base, self._gap, self._silent_s = T_odom_base, None, 0.0
        return step

    def _by_wheels(self, T_prev_curr: Transform, duration_s: float) -> Step | None:
        """Return the motion by odometry, None if odometry jumped."""
        forward_m, yaw_rad = float(T_prev_curr[0, 3]), se3.yaw_rad(T_prev_curr)
        distance_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
        angle_rad = float(se3.rotation_angle_rad(T_prev_curr))
        if distance_m > _LATE_M + _SPEED_MAX_M_S * duration_s:
            return None
        if distance_m < _STILL_M and angle_rad < _STILL_RAD:
            return replace(still(), variance=(_AT_REST * self._floors) ** 2)
        amounts = np.array(
            [distance_m + _METRE_PER_TURN * angle_rad, angle_rad + _TURN_PER_METRE * distance_m]
        )
        missed_rad = self.turns.of_wheels(forward_m, yaw_rad)
        position_m = T_prev_curr[:3, 3] * (1.0 + self._distance.ratio)
        T_axle = se3.from_parts(T_prev_curr[:3, :3], position_m) @ se3.from_xy_yaw(0, 0, missed_rad)
        T_axle_base = se3.from_xy_yaw(self._axle.ratio, 0.0, 0.0)
        swung = np.array([self._axle.variance * yaw_rad**2, 0.0])
        return Step(
            T=se3.inverse(T_axle_base) @ T_axle @ T_axle_base,
            variance=self.noise_ratios**2 * amounts + self._floors**2 + swung,
            amounts=amounts,
            causes=np.array([forward_m, yaw_rad, 0.0]),
        )
