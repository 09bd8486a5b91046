"""Removal of jumps from odometry: resets, and single wrong poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

# Largest plausible excess over twice the previous step: delayed messages (the Intel log has 0.87 m
# and 51 degrees within 20 ms, and no jump) and full acceleration. A pose at the odometry's origin
# is most likely a reset.
_SLACK_M, _SLACK_RAD = 1.0, 1.2
_SLACK_AT_ORIGIN = 0.1  # of both
_ORIGIN_M, _ORIGIN_RAD = 0.05, 0.05  # closer poses count as the origin
_BOOST_M_S2, _BOOST_RAD_S2 = 10.0, 20.0
_COAST_S = 0.5  # longer ago, the last velocity is no prediction any more
SPEED_MAX_MPS = 70.0  # of any vehicle: 250 km/h


class Odometer:
    """Removes jumps from the odometry of successive observations.

    A jump is a motion that exceeds any vehicle's acceleration. It is replaced by the previous
    velocity, for half a second at most. A translation that repeats is a velocity, not a jump.
    """

    def __init__(self) -> None:
        self._before: Observation | None = None  # the last with odometry, unchanged
        self._T_smooth_odom: Transform | None = None  # None until the first jump
        # Of the last step [m/s, rad/s]. Twice of it is plausible in the next one: in the first one
        # any vehicle's speed, as recordings begin while it drives.
        self._rates = np.array([SPEED_MAX_MPS / 2, 0.0])
        self._twist = np.zeros(6)  # the last step's motion per second
        self._jump_mps: NDArray[np.float64] | None = None  # (3,), base, if the last step jumped

    @property
    def T_smooth_odom(self) -> Transform:
        """Return T_smooth_odom (4, 4) [m], the correction since the last jump; identity before."""
        return se3.identity() if self._T_smooth_odom is None else self._T_smooth_odom

    def smooth(self, observation: Observation, log: FaultLog) -> Observation:
        """Return the observation with odometry that continues the previous one's without a jump."""
        before, T_odom_base = self._before, observation.T_odom_base
        if T_odom_base is None:
            return observation
        self._before = observation
        if before is not None and before.T_odom_base is not None:
            duration_s = (observation.stamp_ns - before.stamp_ns) / 1e9
            slack = np.array([_SLACK_M, _SLACK_RAD])
            if (_moved(T_odom_base) < (_ORIGIN_M, _ORIGIN_RAD)).all():
                slack *= _SLACK_AT_ORIGIN
            T_prev_curr = se3.inverse(before.T_odom_base) @ T_odom_base
            if not self._take(T_prev_curr, duration_s, slack):
                log.add("odometry that jumps", at_stamp(observation.stamp_ns))
                T_prev_curr = se3.exp(self._twist * min(duration_s, _COAST_S))
                T_before = self._told(before.T_odom_base)
                self._T_smooth_odom = T_before @ T_prev_curr @ se3.inverse(T_odom_base)
        if self._T_smooth_odom is None:
            return observation
        return replace(observation, T_odom_base=self._told(T_odom_base))

    def _told(self, T_odom_base: Transform) -> Transform:
        offset = self._T_smooth_odom
        return T_odom_base if offset is None else offset @ T_odom_base

    def _take(self, T_prev_curr: Transform, duration_s: float, slack: NDArray[np.float64]) -> bool:
        """Tell whether a motion is plausible after the previous step; if so, store its velocity."""
        moved, velocity_mps = _moved(T_prev_curr), T_prev_curr[:3, 3] / duration_s
        excess = slack + np.array([_BOOST_M_S2, _BOOST_RAD_S2]) * duration_s**2
        is_far, is_turned = moved > excess + 2.0 * self._rates * duration_s
        if is_far and self._jump_mps is not None:
            changed_mps = float(np.linalg.norm(velocity_mps - self._jump_mps))
            is_far = changed_mps * duration_s > excess[0]
        if is_far or is_turned:
            self._jump_mps = velocity_mps
            return False
        self._jump_mps = None
        self._rates, self._twist = moved / duration_s, se3.log(T_prev_curr) / duration_s
        return True


def _moved(T_prev_curr: Transform) -> NDArray[np.float64]:
    """Return (2,): distance [m] and angle of rotation [rad]."""
    way_m = np.linalg.norm(T_prev_curr[:3, 3])
    return np.array([way_m, float(se3.rotation_angle_rad(T_prev_curr))])
