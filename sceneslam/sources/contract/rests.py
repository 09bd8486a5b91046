"""Detection of rests: gaps in a recording over which odometry did not move."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_LONGEST_NS = 24 * 3600 * 10**9  # no battery lasts longer: the clock was set
_LEAST_M, _LEAST_RAD = 0.05, 0.05  # less is odometry noise, or the robot settling


class Rests:
    """Compares each step of odometry with the largest one so far.

    Many loggers write a record only after some centimetres of motion: the step after a rest is then
    as long as any other.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns  # steps over longer gaps are not compared
        self.is_after_rest = False  # whether the last step was no longer than earlier ones
        self._T_odom_base: Transform | None = None
        self._stamp_ns = 0
        self._longest_m, self._widest_rad = _LEAST_M, _LEAST_RAD

    def take(self, observation: Observation) -> None:
        """Update with the next observation of the run."""
        before, self._T_odom_base = self._T_odom_base, observation.T_odom_base
        elapsed_ns, self._stamp_ns = observation.stamp_ns - self._stamp_ns, observation.stamp_ns
        self.is_after_rest = False
        if before is None or self._T_odom_base is None or elapsed_ns > _LONGEST_NS:
            return  # without odometry, motion is unknown
        T_prev_curr = se3.inverse(before) @ self._T_odom_base
        step_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
        turn_rad = float(se3.rotation_angle_rad(T_prev_curr))
        self.is_after_rest = step_m <= self._longest_m and turn_rad <= self._widest_rad
        if elapsed_ns <= self._max_gap_ns:
            self._longest_m = max(self._longest_m, step_m)
            self._widest_rad = max(self._widest_rad, turn_rad)
