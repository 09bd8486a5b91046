"""Simulated wheel odometry and gyro of a drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.robot.motion import STEP_HZ, Path
from sceneslam.sources.simulator.settings import LIES, GyroSettings, OdometrySettings
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_SLIP_S = 0.4  # duration of a slip
_LIES = dict(zip(LIES, (1.0, -1.0, 0.0, 3.0), strict=True))  # ratio of reported to true distance


class WheelOdometry:
    """Dead reckoning from two wheels with scale errors, noise and slip."""

    def __init__(self, path: Path, settings: OdometrySettings, rng: np.random.Generator) -> None:
        speed, turn = path.speed_turn.T
        half_m = settings.wheel_base_m / 2
        wheels_m = np.stack([speed - half_m * turn, speed + half_m * turn]) / STEP_HZ
        wheels_m *= path.stretch()
        scale = 1.0 + settings.scale_error_ratio
        unequal = np.array([[1.0 - settings.unequal_ratio / 2], [1.0 + settings.unequal_ratio / 2]])
        noise = settings.noise_ratio * np.sqrt(np.abs(wheels_m))
        measured_m = wheels_m * scale * unequal + noise * rng.standard_normal(wheels_m.shape)
        measured_m += _slips(len(speed), speed, settings, rng)
        lying = _lying_steps(len(speed), settings, rng)
        measured_m[:, lying] *= _LIES[settings.lie]
        self._x_y_yaw = _integrate(measured_m, settings.wheel_base_m)

    def pose(self, time_s: float) -> Transform:
        """Return T_odom_base (4, 4) [m] at a time."""
        at = min(time_s * STEP_HZ, len(self._x_y_yaw) - 1.0)
        before = min(int(at), len(self._x_y_yaw) - 2)
        start, end = self._x_y_yaw[before : before + 2]
        x, y, yaw = (start + (at - before) * (end - start)).tolist()
        return se3.from_xy_yaw(x, y, yaw)


class SimulatedGyro:
    """Angular velocity in `base` with white noise and a random walk of the bias."""

    def __init__(self, path: Path, settings: GyroSettings, rng: np.random.Generator) -> None:
        self._times_s = np.arange(int(path.duration_s * settings.rate_hz) + 1) / settings.rate_hz
        self._rates = rng.normal(0.0, settings.noise_radps, (len(self._times_s), 3))
        self._rates += rng.normal(0.0, settings.bias_radps, 3)
        steps = rng.standard_normal(self._rates.shape) / np.sqrt(settings.rate_hz)
        self._rates += settings.bias_walk_radps_per_sqrt_s * np.cumsum(steps, axis=0)
        self._rates += [path.turn_rates_radps(float(time_s)) for time_s in self._times_s]

    def samples(self, after_s: float, until_s: float) -> NDArray[np.float64]:
        """Return samples (M, 4) in (after, until]: time - until [s], rates [rad/s], base."""
        first, last = np.searchsorted(self._times_s, [after_s + 1e-9, until_s + 1e-9])
        since_s = self._times_s[first:last, None] - until_s
        return np.hstack([since_s, self._rates[first:last]])


def _slips(
    count: int, speed: NDArray[np.float64], settings: OdometrySettings, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return (2, N) [m]: distance that each wheel reports in each step because of slip."""
    extra_m = np.zeros((2, count))
    expected = settings.slips_per_minute * count / STEP_HZ / 60.0
    length = round(_SLIP_S * STEP_HZ)
    moving = np.flatnonzero(np.abs(speed) > 0.1)
    if len(moving) == 0:
        return extra_m
    for _ in range(rng.poisson(expected)):
        start = int(rng.choice(moving))
        both_m = rng.uniform(0.3, 1.0) * settings.slip_m * rng.uniform(0.6, 1.0, 2)
        part = extra_m[:, start : start + length]
        part += (both_m / length)[:, None]
    return extra_m


def _lying_steps(
    count: int, settings: OdometrySettings, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return (N,) whether the encoders are wrong in each step."""
    lying = np.zeros(count, np.bool_)
    if settings.lie == "none":
        return lying
    length = round(settings.lie_s * STEP_HZ)
    for _ in range(max(1, rng.poisson(settings.lies_per_minute * count / STEP_HZ / 60.0))):
        start = int(rng.integers(max(count - length, 1)))
        lying[start : start + length] = True
    return lying


def _integrate(wheels_m: NDArray[np.float64], wheel_base_m: float) -> NDArray[np.float64]:
    """Return poses (N + 1, 3), x, y [m], yaw [rad], from the wheels' steps (2, N) [m]."""
    left_m, right_m = wheels_m
    yaw = np.concatenate([[0.0], np.cumsum((right_m - left_m) / wheel_base_m)])
    ahead_m, middle = 0.5 * (left_m + right_m), 0.5 * (yaw[:-1] + yaw[1:])
    x = np.concatenate([[0.0], np.cumsum(ahead_m * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(ahead_m * np.sin(middle))])
    return np.stack([x, y, yaw], axis=1)
