"""Rests of the robot: gaps in a recording over which its odometry did not move."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_LONGEST_NS = 24 * 3600 * 10**9  # no battery lasts longer: it is the clock that was set
_LEAST_M, _LEAST_RAD = 0.05, 0.05  # less is the wheels' own noise, or how a robot settles


class Rests:
    """Compares the step of odometry before each observation with the largest so far.

    Many loggers write only what is farther than some centimetres from the last one: the step after
    a rest is then as long as any other.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self._max_gap_ns = max_gap_ns  # steps over longer ones are no measure
        self.is_after_rest = False  # the last step was no longer than those before it
        self._T_odom_base: Transform | None = None
        self._stamp_ns = 0
        self._longest_m, self._widest_rad = _LEAST_M, _LEAST_RAD

    def take(self, observation: Observation) -> None:
        """Take an observation that the run is given."""
        before, self._T_odom_base = self._T_odom_base, observation.T_odom_base
        elapsed_ns, self._stamp_ns = observation.stamp_ns - self._stamp_ns, observation.stamp_ns
        self.is_after_rest = False
        if before is None or self._T_odom_base is None or elapsed_ns > _LONGEST_NS:
            return  # nobody knows whether it moved
        T_prev_curr = se3.inverse(before) @ self._T_odom_base
        step_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
        turn_rad = float(se3.rotation_angle_rad(T_prev_curr))
        self.is_after_rest = step_m <= self._longest_m and turn_rad <= self._widest_rad
        if elapsed_ns <= self._max_gap_ns:
            self._longest_m = max(self._longest_m, step_m)
            self._widest_rad = max(self._widest_rad, turn_rad)
