"""Where the robot should be by now: odometry, gyro, or on at the same velocity."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation

from .calibration import TurnCalibration
from .planar import Matrix, Planar, compose, from_transform, wrap

_STEP_NOISE = np.array([0.003, 0.003, 0.003])  # m, m, rad: floor of any motion's deviation
_LEVER_M = 0.1
_LATE_M = 1.0  # what stamps out of order feign
_COAST_NOISE_M_S2 = 1.5  # a robot's acceleration that nothing measures
_COAST_NOISE_RAD_S2 = 4.0
_COAST_MAX_S = 0.5  # no velocity is kept for longer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """The motion since the last observation."""

    T_prev_curr: Planar
    covariance: Matrix  # axes of prev
    is_measured: bool  # by odometry: holds for long; else it is a guess


@dataclass(slots=True)
class MotionModel:
    """Predicts each observation's motion from what it holds."""

    odometry_noise_ratio: float  # standard deviation per metre and per radian of motion
    odometry_turn_rad_per_m: float
    gyro_noise_rad_s: float
    speed_max_m_s: float  # faster odometry has jumped: it was reset, or the robot was carried
    _stamp_ns: int | None = field(default=None, init=False)
    _T_odom_base: se3.Transform | None = field(default=None, init=False)
    _velocity: Planar = field(default_factory=lambda: np.zeros(3), init=False)
    _turns: TurnCalibration = field(default_factory=TurnCalibration, init=False)
    _turned_rad: float = field(default=0.0, init=False)  # predicted since the last scan

    def step(self, observation: Observation) -> Motion:
        """Return the motion to this observation; no motion at the first one."""
        before_ns, T_odom_prev = self._stamp_ns, self._T_odom_base
        T_odom_base = observation.T_odom_base
        if T_odom_base is not None and not np.isfinite(T_odom_base).all():
            T_odom_base = None
        self._stamp_ns, self._T_odom_base = observation.stamp_ns, T_odom_base
        if before_ns is None:
            is_measured = T_odom_base is not None
            return Motion(
                T_prev_curr=np.zeros(3), covariance=np.zeros((3, 3)), is_measured=is_measured
            )
        duration_s = max((observation.stamp_ns - before_ns) * 1e-9, 0.0)
        motion = self._by_velocity(duration_s)
        if T_odom_base is not None and T_odom_prev is not None:
            T_prev_curr = from_transform(se3.inverse(T_odom_prev) @ T_odom_base)
            if np.hypot(*T_prev_curr[:2]) <= _LATE_M + self.speed_max_m_s * duration_s:
                motion = self._by_odometry(T_prev_curr)
        motion = self._turn(motion, observation.turn_by_gyro(duration_s), duration_s)
        self._turned_rad += float(motion.T_prev_curr[2])
        return motion

    def learn(self, T_before_now: Planar, duration_s: float, turn_deviation_rad: float) -> None:
        """Learn velocity and turn from the motion since the last call, which scans held."""
        if duration_s > 0:
            self._velocity = T_before_now / duration_s
        self._turns.learn(wrap(float(T_before_now[2]) - self._turned_rad), turn_deviation_rad)
        self._turned_rad = 0.0

    def skip(self) -> None:
        """Learn nothing from the motion since the last call: no scan held all of it."""
        self._turns.forget()
        self._turned_rad = 0.0

    def stop(self) -> None:
        """Forget the velocity: it is no longer known."""
        self._velocity = np.zeros(3)
        self.skip()

    def _by_odometry(self, T_prev_curr: Planar) -> Motion:
        distance_m, angle_rad = float(np.hypot(*T_prev_curr[:2])), abs(float(T_prev_curr[2]))
        # A turn about a point that is not quite base moves base sideways.
        along = self.odometry_noise_ratio * distance_m + _LEVER_M * angle_rad
        turn = self.odometry_noise_ratio * angle_rad + self.odometry_turn_rad_per_m * distance_m
        deviation = _STEP_NOISE + np.array([along, along, turn])
        if distance_m == 0.0 and angle_rad == 0.0:
            deviation = 0.3 * _STEP_NOISE  # wheels at rest say so
        return Motion(T_prev_curr=T_prev_curr, covariance=np.diag(deviation**2), is_measured=True)

    def _by_velocity(self, duration_s: float) -> Motion:
        kept_s = min(duration_s, _COAST_MAX_S)
        reach = 0.5 * kept_s * duration_s
        deviation = _STEP_NOISE + reach * np.array(
            [_COAST_NOISE_M_S2, _COAST_NOISE_M_S2, _COAST_NOISE_RAD_S2]
        )
        half = 0.5 * kept_s * self._velocity
        return Motion(
            T_prev_curr=compose(half, half), covariance=np.diag(deviation**2), is_measured=False
        )

    def _turn(
        self, motion: Motion, by_gyro: NDArray[np.float64] | None, duration_s: float
    ) -> Motion:
        """Return the motion with the gyro's turn, where there is one, and without known errors."""
        forward_m, sideways_m, turn_rad = motion.T_prev_curr.tolist()
        covariance = motion.covariance.copy()
        if by_gyro is not None:
            turn_rad = self._turns.correct(float(by_gyro[2]), distance_m=0.0, duration_s=duration_s)
            covariance[2, 2] = (self.gyro_noise_rad_s * duration_s + 0.1 * _STEP_NOISE[2]) ** 2
        elif motion.is_measured:
            turn_rad = self._turns.correct(turn_rad, distance_m=forward_m, duration_s=0.0)
        return Motion(
            T_prev_curr=np.array([forward_m, sideways_m, turn_rad]),
            covariance=covariance,
            is_measured=motion.is_measured,
        )
