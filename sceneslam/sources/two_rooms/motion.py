"""How the robot drives: moves become a differential drive's exact path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

STEP_HZ = 300  # the controller's rate; speeds are constant within a step
_SPEED_LIMIT_MPS = 0.5
_TURN_LIMIT_RADPS = np.deg2rad(58.0)
_ACCELERATION_MPS2 = 0.5
_TURN_ACCELERATION_RADPS2 = 2.5
_LOOKAHEAD_M = 0.32
_SPIN_BEYOND_RAD = np.deg2rad(60.0)  # turns on the spot before it drives


@dataclass(frozen=True, slots=True)
class Wait:
    """Stand still."""

    duration_s: float


@dataclass(frozen=True, slots=True)
class Drive:
    """Follow a polyline from where the robot is, and stop at its end."""

    points_xy_m: tuple[tuple[float, float], ...]
    speed_mps: float = 0.42


@dataclass(frozen=True, slots=True)
class Face:
    """Turn on the spot to a heading, by the shorter way."""

    heading_deg: float
    rate_degps: float = 45.0


@dataclass(frozen=True, slots=True)
class Shift:
    """Drive straight ahead, or back when negative, and stop."""

    distance_m: float
    speed_mps: float = 0.2


Move = Wait | Drive | Face | Shift


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """A drive, step by step: the pose at each step's start and the speeds held in it."""

    x_y_yaw: NDArray[np.float64]  # (N, 3) [m, m, rad], frame gt
    speed_turn: NDArray[np.float64]  # (N, 2) [m/s, rad/s]

    @property
    def duration_s(self) -> float:
        """Return how long the drive takes."""
        return len(self.x_y_yaw) / STEP_HZ

    def pose(self, time_s: float) -> Transform:
        """Return T_gt_base at a time, exactly: steps are circular arcs."""
        index = min(int(time_s * STEP_HZ + 1e-6), len(self.x_y_yaw) - 1)
        speed, turn = self.speed_turn[index]
        x, y, yaw = advance(self.x_y_yaw[index], speed, turn, time_s - index / STEP_HZ)
        return se3.from_xy_yaw(float(x), float(y), float(yaw))

    def turn_rate_radps(self, time_s: float) -> float:
        """Return the rate of turn about z at a time."""
        index = min(int(time_s * STEP_HZ + 1e-6), len(self.x_y_yaw) - 1)
        return float(self.speed_turn[index, 1])


def advance(
    x_y_yaw: NDArray[np.float64], speed_mps: float, turn_radps: float, duration_s: float
) -> NDArray[np.float64]:
    """Return (x, y, yaw) after driving at constant speeds: a circular arc."""
    x, y, yaw = x_y_yaw
    half = 0.5 * turn_radps * duration_s
    chord_m = speed_mps * duration_s * np.sinc(half / np.pi)
    return np.array(
        [x + chord_m * np.cos(yaw + half), y + chord_m * np.sin(yaw + half), yaw + 2 * half]
    )


def plan(start_x_y_deg: tuple[float, float, float], moves: tuple[Move, ...]) -> Path:
    """Return the path that the moves make from a start pose (x [m], y [m], heading [deg])."""
    driver = _Driver(start_x_y_deg)
    for move in moves:
        match move:
            case Wait(duration_s):
                driver.wait(duration_s)
            case Drive(points_xy_m, speed_mps):
                driver.follow(np.array(points_xy_m), speed_mps)
            case Face(heading_deg, rate_degps):
                driver.face(np.deg2rad(heading_deg), np.deg2rad(rate_degps))
            case Shift(distance_m, speed_mps):
                driver.shift(distance_m, speed_mps)
    return Path(x_y_yaw=np.array(driver.poses), speed_turn=np.array(driver.speeds))


class _Driver:
    """Drives with limited speeds and accelerations, and writes down every step."""

    def __init__(self, start_x_y_deg: tuple[float, float, float]) -> None:
        x, y, heading_deg = start_x_y_deg
        self.pose = np.array([x, y, np.deg2rad(heading_deg)])
        self.speed, self.turn = 0.0, 0.0
        self.poses: list[NDArray[np.float64]] = []
        self.speeds: list[tuple[float, float]] = []

    def wait(self, duration_s: float) -> None:
        """Stand still."""
        for _ in range(round(duration_s * STEP_HZ)):
            self._step(0.0, 0.0)

    def face(self, heading_rad: float, rate_radps: float) -> None:
        """Turn to a heading, braking so as to arrive without overshoot."""
        limit = min(rate_radps, _TURN_LIMIT_RADPS)
        while abs(error := _wrap(heading_rad - self.pose[2])) > 2e-4 or abs(self.turn) > 0.02:
            self._step(0.0, float(np.sign(error)) * min(limit, _brake(abs(error), 0.8)))
        self._step(0.0, 0.0)

    def shift(self, distance_m: float, speed_mps: float) -> None:
        """Drive straight by a signed distance."""
        sign, left_m = float(np.sign(distance_m)), abs(distance_m)
        while left_m > 1e-3:
            self._step(sign * min(speed_mps, _brake(left_m, 0.6 * _ACCELERATION_MPS2)), 0.0)
            left_m -= abs(self.speed) / STEP_HZ
        self._stop()

    def follow(self, points_xy_m: NDArray[np.float64], speed_mps: float) -> None:
        """Follow a polyline by pure pursuit of a point ahead on it."""
        line = _sample(np.vstack([self.pose[:2], points_xy_m]))
        at, limit = 0, min(speed_mps, _SPEED_LIMIT_MPS)
        ahead = round(_LOOKAHEAD_M / 0.01)
        while at < len(line) - 4:
            near = np.linalg.norm(line[at : at + 40] - self.pose[:2], axis=1)
            at += int(np.argmin(near))
            target = line[min(at + ahead, len(line) - 1)] - self.pose[:2]
            bearing = _wrap(float(np.arctan2(target[1], target[0])) - self.pose[2])
            if abs(bearing) > _SPIN_BEYOND_RAD:
                self._step(0.0, float(np.sign(bearing)) * min(0.8, _brake(abs(bearing), 0.8)))
                continue
            curvature = 2.0 * np.sin(bearing) / max(float(np.linalg.norm(target)), 0.05)
            speed = min(limit, 0.9 * _TURN_LIMIT_RADPS / max(abs(curvature), 1e-6))
            speed = min(speed, _brake(0.01 * (len(line) - 1 - at), 0.6 * _ACCELERATION_MPS2))
            self._step(speed, max(self.speed, 0.02) * curvature)
        self._stop()

    def _stop(self) -> None:
        while self.speed != 0.0 or self.turn != 0.0:
            self._step(0.0, 0.0)

    def _step(self, speed_mps: float, turn_radps: float) -> None:
        """Approach the wished speeds as fast as the limits allow, for one step."""
        most = _ACCELERATION_MPS2 / STEP_HZ
        self.speed += float(np.clip(speed_mps - self.speed, -most, most))
        most = _TURN_ACCELERATION_RADPS2 / STEP_HZ
        turn = float(np.clip(turn_radps, -_TURN_LIMIT_RADPS, _TURN_LIMIT_RADPS))
        self.turn += float(np.clip(turn - self.turn, -most, most))
        self.poses.append(self.pose)
        self.speeds.append((self.speed, self.turn))
        self.pose = advance(self.pose, self.speed, self.turn, 1.0 / STEP_HZ)


def _brake(left: float, deceleration: float) -> float:
    """Return the highest speed from which one can still stop within what is left."""
    return float(np.sqrt(2.0 * deceleration * left)) + 1e-3


def _wrap(angle_rad: float) -> float:
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def _sample(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points every centimetre along a polyline, its corners rounded off."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], 0.01)
    line = np.stack([np.interp(at, lengths, corners[:, axis]) for axis in (0, 1)], axis=1)
    ramp = np.minimum(np.arange(len(line)), np.arange(len(line))[::-1])
    reach = np.minimum(25, ramp)[:, None]  # half the rounding window, shrinking to the ends
    sums = np.vstack([np.zeros((1, 2)), np.cumsum(line, axis=0)])
    index = np.arange(len(line))[:, None]
    return np.asarray(
        (
            np.take_along_axis(sums, np.hstack([index + reach + 1] * 2), 0)
            - np.take_along_axis(sums, np.hstack([index - reach] * 2), 0)
        )
        / (2 * reach + 1)
    )
