"""What the camera's motion is expected to be, and how far that can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

from ..surfaces.surface import Doubles

_NS = 1e-9
_GAP_MAX_S = 0.5  # beyond, a velocity says nothing any more
_START_SPEED = np.array([1.0, 2.0])  # m/s, rad/s: standard deviation where none is known
_JERKED = np.array([3.0, 15.0])  # m/s^2, rad/s^2: how fast a hand or robot changes its velocity
_ODOMETRY_SHARE = np.array([0.05, 0.05])  # of the way [m] and the turn [rad], as standard deviation
_ODOMETRY_STEP = np.array([5e-4, 5e-4])  # m, rad: the least per step
_GYRO_RATE = 0.01  # rad/s
_GYRO_SHARE = 0.02  # of the turn
_FADE_S = 0.5  # in which a velocity that nothing confirms is forgotten


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The base's expected pose."""

    T_local_base: Transform
    covariance: Doubles  # (6, 6) of se3.log order, base
    is_measured: bool  # by odometry


class Motion:
    """Carries pose and covariance from one observation to the next.

    By odometry where there is any, else with constant velocity; a gyro turns either.
    """

    def __init__(self) -> None:
        self.T_local_base = se3.identity()
        self.covariance = np.eye(6) * 1e-8  # rel. to the map around
        self._twist_s: Doubles | None = None  # base's motion per second
        self._stamp_ns: int | None = None
        self._T_odom_base: Transform | None = None

    def predict(self, observation: Observation) -> Prediction:
        """Return where the base should be at the observation."""
        if self._stamp_ns is None:
            return Prediction(
                self.T_local_base, self.covariance, _odometry(observation) is not None
            )
        gap_s = max((observation.stamp_ns - self._stamp_ns) * _NS, 0.0)
        T_prev_odom, T_odom = self._T_odom_base, _odometry(observation)
        is_measured = T_prev_odom is not None and T_odom is not None
        if T_prev_odom is not None and T_odom is not None:
            T_prev_curr = se3.inverse(T_prev_odom) @ T_odom
            moved = float(np.linalg.norm(T_prev_curr[:3, 3]))
            turned = float(se3.rotation_angle_rad(T_prev_curr)) + moved  # a wheel's error turns too
            deviation = _ODOMETRY_SHARE * np.array([moved, turned]) + _ODOMETRY_STEP
        elif self._twist_s is not None and gap_s <= _GAP_MAX_S:
            T_prev_curr = se3.exp(self._twist_s * gap_s)
            deviation = 0.5 * _JERKED * gap_s**2 + 1e-4
        else:
            T_prev_curr, deviation = se3.identity(), _START_SPEED * gap_s + 1e-4
        turn = observation.turn_by_gyro(gap_s)
        if turn is not None:
            T_prev_curr = se3.from_parts(se3.so3_exp(turn), T_prev_curr[:3, 3])
            by_gyro = _GYRO_RATE * gap_s + _GYRO_SHARE * float(np.linalg.norm(turn))
            deviation = np.array([deviation[0], min(deviation[1], by_gyro)])
        carry = se3.adjoint(se3.inverse(T_prev_curr))
        covariance = carry @ self.covariance @ carry.T + np.diag(np.repeat(deviation**2, 3))
        return Prediction(self.T_local_base @ T_prev_curr, covariance, is_measured)

    def hold(
        self, observation: Observation, T_local_base: Transform, covariance: Doubles, weak: Doubles
    ) -> None:
        """Go on from a measured pose; `weak` (K, 6) are the twists that nothing measured."""
        if self._stamp_ns is not None:
            gap_s = (observation.stamp_ns - self._stamp_ns) * _NS
            twist = se3.log(se3.inverse(self.T_local_base) @ T_local_base)
            self._twist_s = twist / gap_s if gap_s > 0 else None
            if self._twist_s is not None and len(weak):
                along = np.linalg.pinv(weak) @ weak
                self._twist_s -= (1.0 - np.exp(-gap_s / _FADE_S)) * (along @ self._twist_s)
        self._step(observation, T_local_base, covariance)

    def coast(self, observation: Observation, prediction: Prediction) -> None:
        """Go on from a prediction."""
        self._step(observation, prediction.T_local_base, prediction.covariance)

    def stop(self) -> None:
        """Stay where the base was last seen: predictions go on from there, in growing doubt."""
        self._twist_s = None

    def jump(self, T_local_base: Transform) -> None:
        """Hear that the map, and the pose with it, was corrected."""
        self.T_local_base = T_local_base

    def _step(self, observation: Observation, T_local_base: Transform, covariance: Doubles) -> None:
        self.T_local_base, self.covariance = T_local_base, covariance
        self._stamp_ns, self._T_odom_base = observation.stamp_ns, _odometry(observation)


def _odometry(observation: Observation) -> Transform | None:
    T_odom_base = observation.T_odom_base
    return T_odom_base if T_odom_base is not None and np.isfinite(T_odom_base).all() else None
