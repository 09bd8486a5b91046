"""Motion compensation: points that a lidar measured one after the other, as from one instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform


def deskewed(
    observation: Observation, T_base_lidar: Transform, twist_s: NDArray[np.float64]
) -> NDArray[np.floating]:
    """Return the cloud (N, 3) [m], lidar, as from the observation's stamp.

    `twist_s` (6,) is the velocity of base, of se3.log order. Points without times stay. Raises
    InputError unless all points have a time or none.
    """
    points, times_s = observation.points_lidar, observation.point_times_s
    assert points is not None
    if times_s is None:
        return points
    check_times(times_s, points)
    twist_lidar_s = se3.adjoint(se3.inverse(T_base_lidar)) @ twist_s
    return moved(points.astype(np.float64), valid_times_s(times_s), twist_lidar_s)


def valid_times_s(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points' times (N,) [s], 0 for those that are not finite."""
    return np.nan_to_num(times_s, nan=0.0, posinf=0.0, neginf=0.0)


def check_times(times_s: NDArray[np.float64], points: NDArray[np.floating]) -> None:
    """Raise InputError unless every point (N, 3) has a time (N,)."""
    if len(times_s) != len(points):
        raise InputError(f"point_times_s: expected {len(points)} values, got {len(times_s)}")


def moved(
    points: NDArray[np.float64], times_s: NDArray[np.float64], twist_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the points (N, 3) [m] moved by the twist times each point's time."""
    rate = twist_s[3:]
    speed = float(np.linalg.norm(rate))
    shift = times_s[:, None] * twist_s[:3]
    if speed < 1e-9:
        return points + shift
    axis = rate / speed
    angle = (speed * times_s)[:, None]
    across = np.cross(axis, points)
    turned = points + np.sin(angle) * across + (1.0 - np.cos(angle)) * np.cross(axis, across)
    return np.asarray(turned + shift)
