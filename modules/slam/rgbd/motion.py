"""Where the robot should be by now, before its camera is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_NS = 1e-9
_MAX_GAP_S = 0.5  # beyond it, a velocity says nothing any more
_GYRO_RAD_PER_S = 0.02  # deviation of a gyro's turn rate
_TURN_RAD_PER_S2 = 6.0  # of a hand: a rate is that of half a step ago
_TURN_RAD_PER_S = 1.0  # of a camera of which nothing is known


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TurnRate:
    """How fast the base turns, and how sure that is."""

    rate_base: NDArray[np.float64]  # (3,) [rad/s]
    sigma_rad_per_s: float

    @property
    def is_unknown(self) -> bool:
        """Tell whether nothing but an image can say it."""
        return self.sigma_rad_per_s >= _TURN_RAD_PER_S


class MotionModel:
    """Predicts by odometry, else by constant velocity; the rotation is the gyro's where it has one.

    Wheels measure the way well and turns badly: half a second of a slip is a degree.
    """

    def __init__(self) -> None:
        self._T_local_base = se3.identity()
        self._twist_per_s = np.zeros(6)
        self._stamp_ns: int | None = None
        self._T_odom_base: Transform | None = None
        self._held_ns: int | None = None
        self.is_reckoned = False  # odometry has carried the pose since it was last measured

    def predict(self, observation: Observation) -> Transform:
        """Return the expected T_local_base at the observation."""
        if self._T_odom_base is not None and observation.T_odom_base is not None:
            T_prev_curr = se3.inverse(self._T_odom_base) @ observation.T_odom_base
            gap_s = self._gap_s(observation)
            if gap_s > 0 and _gyro_rate(observation) is not None:
                T_prev_curr[:3, :3] = se3.so3_exp(self.turn_rate(observation) * gap_s)
            return self._T_local_base @ T_prev_curr
        twist = np.concatenate([self._twist_per_s[:3], self.turn_rate(observation)])
        return self._T_local_base @ se3.exp(twist * self._gap_s(observation))

    def turn_rate(self, observation: Observation) -> NDArray[np.float64]:
        """Return how fast the base should turn (3,) [rad/s], by the gyro if there is one."""
        rate = _gyro_rate(observation)
        return self._twist_per_s[3:] if rate is None else rate

    def turning(self, observation: Observation, T_local_base: Transform) -> TurnRate:
        """Return how fast the base turned at an observation whose pose is found.

        The gyro's rate, else that of the way from the last pose; after the camera was lost, none.
        """
        rate, gap_s = _gyro_rate(observation), self._gap_s(observation)
        if rate is not None:
            return TurnRate(rate_base=rate, sigma_rad_per_s=_GYRO_RAD_PER_S)
        if not gap_s or self._held_ns != self._stamp_ns:
            return TurnRate(rate_base=np.zeros(3), sigma_rad_per_s=_TURN_RAD_PER_S)
        T_prev_curr = se3.inverse(self._T_local_base) @ T_local_base
        rate = se3.so3_log(T_prev_curr[:3, :3]) / gap_s
        return TurnRate(rate_base=rate, sigma_rad_per_s=_TURN_RAD_PER_S2 * gap_s)

    def unheld_s(self, observation: Observation) -> float:
        """Return how long no pose was measured; 0 before there was any."""
        return 0.0 if self._held_ns is None else (observation.stamp_ns - self._held_ns) * _NS

    def hold(self, observation: Observation, T_local_base: Transform) -> None:
        """Go on from a pose that was measured."""
        gap_s = self._gap_s(observation)
        is_moving = gap_s > 0 and self._held_ns == self._stamp_ns
        T_prev_curr = se3.inverse(self._T_local_base) @ T_local_base
        self._twist_per_s = se3.log(T_prev_curr) / gap_s if is_moving else np.zeros(6)
        self._step(observation, T_local_base)
        self._held_ns = observation.stamp_ns
        self.is_reckoned = observation.T_odom_base is not None

    def correct(self, T_new_old: Transform) -> None:
        """Hear that the map around the last pose was moved.

        The move is a product of this pose where the last keyframe was inserted at a prediction:
        what rounding leaves in the rotation would triple with every correction.
        """
        self._T_local_base = se3.orthonormal(T_new_old @ self._T_local_base)

    def lose(self, observation: Observation, T_predicted: Transform) -> None:
        """Go on from a prediction; without odometry or gyro, as if at rest."""
        self._twist_per_s = np.zeros(6)
        self._step(observation, T_predicted)
        self.is_reckoned = self.is_reckoned and observation.T_odom_base is not None

    def _step(self, observation: Observation, T_local_base: Transform) -> None:
        self._T_local_base, self._stamp_ns = T_local_base, observation.stamp_ns
        self._T_odom_base = observation.T_odom_base

    def _gap_s(self, observation: Observation) -> float:
        if self._stamp_ns is None:
            return 0.0
        gap_s = (observation.stamp_ns - self._stamp_ns) * _NS
        return gap_s if 0.0 < gap_s <= _MAX_GAP_S else 0.0


def _gyro_rate(observation: Observation) -> NDArray[np.float64] | None:
    """Return the mean turn rate (3,) [rad/s] of an observation's gyro, None without one."""
    gyro = observation.gyro_base
    if gyro is None or not len(gyro) or not np.isfinite(gyro[:, 1:4]).all():
        return None
    return np.asarray(gyro[:, 1:4].mean(axis=0))
