"""Wheel odometry that turns by the gyro: a wheel that slips does not turn the robot.

Wheels measure the way well and turns badly, a gyro turns well but for its bias (Borenstein and
Feng, "Gyrodometry", ICRA 1996). The bias is the median of what the two say differently, which no
slip moves; wheels that always pull to one side do, and are then followed as they would be alone.
"""

from __future__ import annotations

from dataclasses import replace

from sceneslam.bus.recent import RecentMedian
from sceneslam.types import se3
from sceneslam.types.observation import Observation

_KEPT = 512  # differences that the median is taken of: 17 s at 30 Hz, longer than any slip
_DOUBT = 10  # so many say as much as a calibrated gyro says before: that it has no bias


class Gyrodometry:
    """Corrects the heading of one observation's odometry after the other."""

    def __init__(self) -> None:
        self._apart_radps = RecentMedian(_KEPT, width=1)  # gyro less wheels
        self._before: Observation | None = None  # the last that had odometry, as it came ...
        self._T_odom_base = se3.identity()  # ... and its pose as corrected

    def correct(self, observation: Observation) -> Observation:
        """Return the observation with odometry that turned by the gyro wherever that tells."""
        before, T_odom_base = self._before, observation.T_odom_base
        if T_odom_base is None:
            return observation
        self._before = observation
        if before is None or before.T_odom_base is None:
            self._T_odom_base = T_odom_base
            return observation
        T_prev_curr = se3.inverse(before.T_odom_base) @ T_odom_base
        duration_s = (observation.stamp_ns - before.stamp_ns) / 1e9
        turn = observation.turn_by_gyro(duration_s)
        if turn is not None:
            apart_radps = (float(turn[2]) - se3.yaw_rad(T_prev_curr)) / duration_s
            missed_rad = (apart_radps - self._bias_with(apart_radps)) * duration_s
            T_prev_curr = T_prev_curr @ se3.from_xy_yaw(0.0, 0.0, missed_rad)
        self._T_odom_base = se3.chained(self._T_odom_base, T_prev_curr)
        return replace(observation, T_odom_base=self._T_odom_base)

    def shift(self, bias_radps: float) -> None:
        """Take note that the gyro comes with so much less bias from now on."""
        if bias_radps:
            self._apart_radps.shift(-bias_radps)

    def _bias_with(self, apart_radps: float) -> float:
        """Return the gyro's bias [rad/s] by all differences so far, this one too."""
        self._apart_radps.add(apart_radps)
        kept = len(self._apart_radps)
        return float(self._apart_radps.median[0]) * kept / (kept + _DOUBT)
