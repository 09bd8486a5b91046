"""A gyro without its bias: what it tells while the wheels stand still is no turn."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.hold import Hold
from sceneslam.bus.recent import RecentMedian
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_SPAN_S = 0.25  # of rest, that one value of the bias is the mean of
_AFTER_S = 0.25  # of rest before and after it: wheels speak late, and a robot rocks when it stops
_KEPT = 64  # values that the bias is the median of: it follows a gyro that warms up
_STILL_M, _STILL_RAD = 1e-4, 1e-4  # over the whole rest: less than a step of any wheel's encoder
_TURNED_RAD = 0.01  # by a trusted module: it is not the robot that rests, but its wheels
_SCATTER_RADPS = 0.05  # between samples of a gyro at rest: ten times a cheap one's noise
_BIAS_MAX_RADPS = 0.05  # 3 degrees per second, as data sheets allow; the rest is a turn


@dataclass(slots=True)
class _Rest:
    """Since when, and where, the wheels stand still."""

    stamp_ns: int
    T_odom_base: Transform
    samples: list[NDArray[np.float64]] = field(default_factory=list)  # (M, 4): time since then [s]
    taken_s: float = _AFTER_S  # until then they were looked at
    hold: Hold | None = None  # of the module that watches ...
    T_local_base: Transform | None = None  # ... and where it first saw the robot rest


class GyroZero:
    """Takes the bias out of the gyro of one observation after the other."""

    def __init__(self) -> None:
        self.bias_radps = np.zeros(3)  # as far as is known
        self._means = RecentMedian(_KEPT, width=3)
        self._rest: _Rest | None = None

    def correct(self, observation: Observation) -> Observation:
        """Return the observation with a gyro that has no bias, as far as is known so far."""
        if observation.gyro_base is None:
            return observation
        if observation.T_odom_base is not None:
            self._look(observation.stamp_ns, observation.T_odom_base, observation.gyro_base)
        if not len(self._means):
            return observation
        gyro = observation.gyro_base.copy()
        gyro[:, 1:] -= self.bias_radps
        gyro.setflags(write=False)
        return replace(observation, gyro_base=gyro)

    def watch(self, hold: Hold) -> None:
        """End a rest during which the active module saw the robot turn."""
        rest, T_local_base = self._rest, hold.T_local_base
        if rest is None or T_local_base is None or not hold.is_trusted:
            return
        if rest.hold is not hold or rest.T_local_base is None or hold.is_revised:
            rest.hold, rest.T_local_base = hold, T_local_base
        elif se3.rotation_angle_rad(se3.inverse(rest.T_local_base) @ T_local_base) > _TURNED_RAD:
            self._rest = None

    def _look(self, stamp_ns: int, T_odom_base: Transform, gyro: NDArray[np.float64]) -> None:
        """Take in the samples of a robot that has not moved for a while, and does not yet."""
        rest = self._rest
        if rest is None or not _is_still(rest.T_odom_base, T_odom_base):
            self._rest = _Rest(stamp_ns, T_odom_base)
            return
        rested_s = (stamp_ns - rest.stamp_ns) / 1e9
        rest.samples.append(gyro + np.array([rested_s, 0.0, 0.0, 0.0]))
        known_s = rested_s - _AFTER_S
        if known_s < rest.taken_s + _SPAN_S:
            return
        samples = np.concatenate(rest.samples)
        times_s = samples[:, 0]
        self._take(samples[(times_s > rest.taken_s) & (times_s <= known_s), 1:])
        rest.samples, rest.taken_s = [samples[times_s > known_s]], known_s

    def _take(self, rates: NDArray[np.float64]) -> None:
        """Take in the samples of a span of rest, unless the robot was carried or shaken."""
        if len(rates) == 0 or not np.ptp(rates, axis=0).max() <= _SCATTER_RADPS:
            return
        mean = rates.mean(axis=0)
        if not np.abs(mean).max() <= _BIAS_MAX_RADPS:
            return
        self._means.add(mean)
        self.bias_radps = self._means.median


def _is_still(T_before: Transform, T_now: Transform) -> bool:
    T_before_now = se3.inverse(T_before) @ T_now
    is_here = float(np.linalg.norm(T_before_now[:3, 3])) <= _STILL_M
    return is_here and float(se3.rotation_angle_rad(T_before_now)) <= _STILL_RAD
