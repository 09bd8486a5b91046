"""Roll and pitch by a gyro, held by gravity or by the floor.

A complementary filter on rotations (Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on
the special orthogonal group", TAC 2008, Eq. 32) without its bias: the gyro's is estimated elsewhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import GRAVITY

_BY_GRAVITY_S = 5.0  # time constant: accelerating and braking last a second
_BY_FLOOR_S = 10.0  # a robot is seldom on a slope for longer
_FORCE_RATIO = 0.1  # a force that differs by more from gravity's is mostly acceleration


def up_by(accelerometer: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the upward direction (3,) in base by samples (M, 4) of specific force, if they tell.

    None without samples, and while the base accelerates.
    """
    if accelerometer is None or not len(accelerometer):
        return None
    force = accelerometer[:, 1:].mean(axis=0)
    size = float(np.linalg.norm(force))
    if not abs(size - GRAVITY) < _FORCE_RATIO * GRAVITY:  # false for NaN
        return None
    return np.asarray(force / size)


def levelled(
    rotation: NDArray[np.float64], up_base: NDArray[np.float64] | None, duration_s: float
) -> NDArray[np.float64]:
    """Return a rotation R_odom_base (3, 3), turned towards where `up_base` (3,) points upwards.

    By the share of the error that belongs to `duration_s`. None: towards where base is level, more
    slowly.
    """
    time_s = _BY_FLOOR_S if up_base is None else _BY_GRAVITY_S
    up = rotation[:, 2] if up_base is None else rotation @ up_base
    axis = np.array([up[1], -up[0], 0.0])  # up x z: turns up towards z
    share = min(duration_s / time_s, 1.0)
    return np.asarray(se3.so3_exp(share * axis) @ rotation)
