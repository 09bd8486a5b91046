"""Roll and pitch by a gyro, held by gravity or by the odometry.

A complementary filter on rotations (Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on
the special orthogonal group", TAC 2008, Eq. 32), without its bias: `TurnErrors` estimates that.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import GRAVITY
from sceneslam.types.se3 import Transform

_BY_GRAVITY_S = 5.0  # time constant: accelerating and braking last a second
_BY_ODOMETRY_S = 10.0  # wheels know no slope; a robot is seldom on one for longer
_STEEPEST_COS = np.cos(np.radians(30.0))  # no robot stands steeper: the sensor is mounted otherwise
_FORCE_RATIO = 0.1  # a force that differs by more from gravity's is mostly acceleration


def up_by(accelerometer: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the upward direction (3,) in base by samples (M, 4) of specific force, if they tell.

    None without samples, while the base accelerates, and for a direction far from base's own z.
    """
    if accelerometer is None or not len(accelerometer):
        return None
    force = accelerometer[:, 1:].mean(axis=0)
    size = float(np.linalg.norm(force))
    if not abs(size - GRAVITY) < _FORCE_RATIO * GRAVITY:  # false for NaN
        return None
    return np.asarray(force / size) if force[2] >= _STEEPEST_COS * size else None


def levelled(
    T_odom_base: Transform,
    duration_s: float,
    *,
    by_gravity: NDArray[np.float64] | None,
    by_odometry: NDArray[np.float64],
) -> Transform:
    """Return T_odom_base (4, 4), turned so that a direction (3,) in base points upwards.

    The direction is that of gravity, or of the odometry without it. The pose is turned by the share
    of the error that belongs to `duration_s`.
    """
    up_base, time_s = by_odometry, _BY_ODOMETRY_S
    if by_gravity is not None:
        up_base, time_s = by_gravity, _BY_GRAVITY_S
    up = T_odom_base[:3, :3] @ up_base
    axis = np.array([up[1], -up[0], 0.0])  # up x z: turns up towards z
    turn = se3.so3_exp(min(duration_s / time_s, 1.0) * axis)
    return se3.from_parts(turn @ T_odom_base[:3, :3], T_odom_base[:3, 3])
