"""A gyro without its bias: what it tells while the wheels stand still is no turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation

_SPAN_S = 0.25  # of rest, that one value of the bias is the mean of
_AFTER_S = 0.25  # of rest before and after it: wheels speak late, and a robot rocks when it stops
_KEPT = 64  # values that the bias is the median of: it follows a gyro that warms up
_STILL_M, _STILL_RAD = 1e-4, 1e-4  # over the whole rest: less than a step of any wheel's encoder
_SCATTER_RADPS = 0.05  # between samples of a gyro at rest: ten times a cheap one's noise
_BIAS_MAX_RADPS = 0.35  # what the worst of them may tell at rest (20 degrees per second)


class GyroZero:
    """Takes the bias out of the gyro of one observation after the other."""

    def __init__(self) -> None:
        self.bias_radps = np.zeros(3)  # as far as is known
        self._means = np.zeros((_KEPT, 3))  # a ring
        self._count = 0
        self._rest: Observation | None = None  # the first of those at which the robot stood here
        self._samples: list[NDArray[np.float64]] = []  # (M, 4) each: time since then [s], rate
        self._taken_s = _AFTER_S  # until then they were looked at

    def correct(self, observation: Observation) -> Observation:
        """Return the observation with a gyro that has no bias, as far as is known so far."""
        if observation.gyro_base is None:
            return observation
        self._learn(observation, observation.gyro_base)
        if not self._count:
            return observation
        gyro = observation.gyro_base.copy()
        gyro[:, 1:] -= self.bias_radps
        gyro.setflags(write=False)
        return replace(observation, gyro_base=gyro)

    def _learn(self, observation: Observation, gyro_base: NDArray[np.float64]) -> None:
        """Take in the samples of a robot that has not moved for a while, and does not yet."""
        if self._rest is None or not self._stands(observation):
            self._rest = observation if observation.T_odom_base is not None else None
            self._samples, self._taken_s = [], _AFTER_S
            return
        rested_s = (observation.stamp_ns - self._rest.stamp_ns) / 1e9
        self._samples.append(gyro_base + np.array([rested_s, 0.0, 0.0, 0.0]))
        known_s = rested_s - _AFTER_S
        if observation.T_odom_base is None or known_s < self._taken_s + _SPAN_S:
            return
        samples = np.concatenate(self._samples)
        times_s = samples[:, 0]
        self._take(samples[(times_s > self._taken_s) & (times_s <= known_s), 1:])
        self._samples, self._taken_s = [samples[times_s > known_s]], known_s

    def _stands(self, observation: Observation) -> bool:
        """Tell whether the wheels, as far as they speak, have not moved since the rest began."""
        assert self._rest is not None and self._rest.T_odom_base is not None
        if observation.T_odom_base is None:
            return True
        T_rest_now = se3.inverse(self._rest.T_odom_base) @ observation.T_odom_base
        is_here = float(np.linalg.norm(T_rest_now[:3, 3])) <= _STILL_M
        return is_here and float(se3.rotation_angle_rad(T_rest_now)) <= _STILL_RAD

    def _take(self, rates: NDArray[np.float64]) -> None:
        """Take in the samples of a span of rest, unless the robot was carried or shaken."""
        if len(rates) == 0 or np.ptp(rates, axis=0).max() > _SCATTER_RADPS:
            return
        mean = rates.mean(axis=0)
        if np.abs(mean).max() > _BIAS_MAX_RADPS:
            return
        self._means[self._count % _KEPT] = mean
        self._count += 1
        self.bias_radps = np.median(self._means[: min(self._count, _KEPT)], axis=0)
