"""Motion of the robot: moves are converted to the exact path of a differential drive."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.places.floor import Floor
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

STEP_HZ = 300  # the controller's rate; speeds are constant within a step
_SPEED_LIMIT_MPS = 0.8
_TURN_LIMIT_RADPS = np.deg2rad(58.0)
_ACCELERATION_MPS2 = 0.5
_TURN_ACCELERATION_RADPS2 = 2.5
_LOOKAHEAD_M = 0.32
_AXLE_M = 0.12  # distance from the robot's centre to the wheels' contact points
_HALF_S = 0.5e-3  # half the interval of numerical differentiation
_SPIN_BEYOND_RAD = np.deg2rad(60.0)  # larger heading errors are corrected on the spot first


@dataclass(frozen=True, slots=True)
class Wait:
    """Stand still."""

    duration_s: float


@dataclass(frozen=True, slots=True)
class Drive:
    """Follow a polyline from the current position, and stop at its end."""

    points_xy_m: tuple[tuple[float, float], ...]
    speed_mps: float = 0.42


@dataclass(frozen=True, slots=True)
class Face:
    """Turn on the spot to a heading, by the smaller angle."""

    heading_deg: float
    rate_degps: float = 45.0


@dataclass(frozen=True, slots=True)
class Shift:
    """Drive straight ahead, or back if negative, and stop."""

    distance_m: float
    speed_mps: float = 0.2


Move = Wait | Drive | Face | Shift


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """A drive in steps: the pose at the start of each step and its constant speeds."""

    x_y_yaw: NDArray[np.float64]  # (N, 3) [m, m, rad], frame gt
    speed_turn: NDArray[np.float64]  # (N, 2) [m/s, rad/s], horizontal
    floor: Floor = field(default_factory=Floor)

    @property
    def duration_s(self) -> float:
        """Return the duration of the drive."""
        return len(self.x_y_yaw) / STEP_HZ

    def pose(self, time_s: float) -> Transform:
        """Return T_gt_base (4, 4) [m] at a time, on the floor; steps are exact circular arcs."""
        index = min(int(time_s * STEP_HZ + 1e-6), len(self.x_y_yaw) - 1)
        speed, turn = self.speed_turn[index]
        x, y, yaw = advance(self.x_y_yaw[index], speed, turn, time_s - index / STEP_HZ)
        T_gt_base = se3.from_xy_yaw(float(x), float(y), float(yaw))
        is_raised = self.floor.is_raised_near(float(x), float(y))
        return _stand(T_gt_base, self.floor) if is_raised else T_gt_base

    def turn_rates_radps(self, time_s: float) -> NDArray[np.float64]:
        """Return the angular velocity (3,) [rad/s] in `base` at a time."""
        index = min(int(time_s * STEP_HZ + 1e-6), len(self.x_y_yaw) - 1)
        x, y, _ = self.x_y_yaw[index].tolist()
        if not self.floor.is_raised_near(x, y):
            return np.array([0.0, 0.0, self.speed_turn[index, 1]])
        before, after = self.pose(max(time_s - _HALF_S, 0.0)), self.pose(time_s + _HALF_S)
        return se3.so3_log(before[:3, :3].T @ after[:3, :3]) / (2.0 * _HALF_S)

    def stretch(self) -> NDArray[np.float64]:
        """Return (N,) the ratio of the wheels' distance to the robot's horizontal one in each step.

        It is above 1 on slopes, and where wheels slip.
        """
        x, y, yaw = self.x_y_yaw.T
        ahead = _AXLE_M * np.cos(yaw), _AXLE_M * np.sin(yaw)
        rise = self.floor.height_m(x + ahead[0], y + ahead[1])
        rise = rise - self.floor.height_m(x - ahead[0], y - ahead[1])
        return np.hypot(1.0, rise / (2.0 * _AXLE_M)) / (1.0 - self.floor.slip_ratio(x, y))


def advance(
    x_y_yaw: NDArray[np.float64], speed_mps: float, turn_radps: float, duration_s: float
) -> NDArray[np.float64]:
    """Return (..., 3), x, y [m] and yaw [rad], after a circular arc at constant speeds."""
    x, y, yaw = x_y_yaw
    half = 0.5 * turn_radps * duration_s
    chord_m = speed_mps * duration_s * np.sinc(half / np.pi)
    return np.array(
        [x + chord_m * np.cos(yaw + half), y + chord_m * np.sin(yaw + half), yaw + 2 * half]
    )


def plan(
    start_x_y_deg: tuple[float, float, float],
    moves: tuple[Move, ...],
    floor: Floor | None = None,
) -> Path:
    """Return the path of moves from a start pose (x [m], y [m], heading [deg])."""
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
    poses, speeds = np.array(driver.poses), np.array(driver.speeds)
    return Path(x_y_yaw=poses, speed_turn=speeds, floor=floor or Floor())


def _stand(T_gt_base: Transform, floor: Floor) -> Transform:
    """Return a planar pose raised and tilted by the floor's height at the four contact points."""
    offsets = _AXLE_M * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    points = np.asarray(se3.apply(T_gt_base, offsets), np.float64)
    points[:, 2] = floor.height_m(points[:, 0], points[:, 1])
    ahead, left = points[0] - points[1], points[2] - points[3]
    up = np.cross(ahead, left)
    x, z = ahead / np.linalg.norm(ahead), up / np.linalg.norm(up)
    standing = np.eye(4)
    standing[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    standing[:3, 3] = [*T_gt_base[:2, 3], points[:, 2].mean()]
    return standing


class _Driver:
    """Drives with limited speeds and accelerations; records every step."""

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
        """Turn to a heading without overshoot."""
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
        """Follow a polyline by pure pursuit."""
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
        """Approach the target speeds within the acceleration limits, for one step."""
        most = _ACCELERATION_MPS2 / STEP_HZ
        self.speed += max(-most, min(speed_mps - self.speed, most))
        most = _TURN_ACCELERATION_RADPS2 / STEP_HZ
        turn = float(max(-_TURN_LIMIT_RADPS, min(turn_radps, _TURN_LIMIT_RADPS)))
        self.turn += max(-most, min(turn - self.turn, most))
        self.poses.append(self.pose)
        self.speeds.append((self.speed, self.turn))
        self.pose = advance(self.pose, self.speed, self.turn, 1.0 / STEP_HZ)


def _brake(left: float, deceleration: float) -> float:
    """Return the highest speed that allows stopping within the remaining distance."""
    return sqrt(2.0 * deceleration * left) + 1e-3


def _wrap(angle_rad: float) -> float:
    return float((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)


def _sample(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (N, 2) [m], one per centimetre, of a polyline with rounded corners."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], 0.01)
    line = np.stack([np.interp(at, lengths, corners[:, axis]) for axis in (0, 1)], axis=1)
    ramp = np.minimum(np.arange(len(line)), np.arange(len(line))[::-1])
    reach = np.minimum(25, ramp)[:, None]  # half the smoothing window, smaller towards the ends
    sums = np.vstack([np.zeros((1, 2)), np.cumsum(line, axis=0)])
    index = np.arange(len(line))[:, None]
    return np.asarray(
        (
            np.take_along_axis(sums, np.hstack([index + reach + 1] * 2), 0)
            - np.take_along_axis(sums, np.hstack([index - reach] * 2), 0)
        )
        / (2 * reach + 1)
    )
