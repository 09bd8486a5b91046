"""Roll and pitch by a gyro, held by gravity or by the odometry.

A complementary filter on rotations (Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on
the special orthogonal group", TAC 2008, Eq. 32 and 33).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.model import MotionModel
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import GRAVITY
from sceneslam.types.se3 import Transform, Vector

_BY_GRAVITY_S = 5.0  # time constant: accelerating and braking last a second
_BY_ODOMETRY_S = 10.0  # wheels know no slope; a robot is seldom on one for longer
_STEEPEST_COS = np.cos(np.radians(30.0))  # no robot stands steeper: the sensor is mounted otherwise
_SLOPE_SIN = np.sin(np.radians(2.5))  # by the gyro base stands on a slope, which wheels do not know
_FORCE_RATIO = 0.1  # a force that differs by more from gravity's is mostly acceleration
_NO_TURN = 1e-12


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


def upright(T_world_base: Transform, up_base: Vector) -> Transform:
    """Return a pose (4, 4), turned about a horizontal axis until `up_base` (3,) points upwards."""
    up = T_world_base[:3, :3] @ up_base
    axis = np.array([up[1], -up[0], 0.0])  # up x z
    sine = float(np.linalg.norm(axis))
    if sine < _NO_TURN:
        return T_world_base
    turn = se3.so3_exp(axis * (np.arctan2(sine, up[2]) / sine))
    return se3.from_parts(turn @ T_world_base[:3, :3], T_world_base[:3, 3])


class Tilt:
    """Estimates the vertical direction, and the gyro's bias about the horizontal axes."""

    def __init__(self, model: MotionModel) -> None:
        """`model` predicts the turn; it is not changed."""
        self._model = model
        self._R_level_base: NDArray[np.float64] | None = None  # (3, 3)
        self._bias_radps = np.zeros(3)  # that the model has not found

    def update(self, observation: Observation, turn: NDArray[np.float64]) -> Vector | None:
        """Return the upward direction (3,) in base, None without odometry or a gyro that rested.

        `turn` (3, 3) is the model's since the last observation.
        """
        T_odom_base, duration_s = observation.T_odom_base, self._model.duration_s
        if not self._model.turns.knows_level_bias:
            return None
        if self._R_level_base is None:
            if T_odom_base is None:
                return None
            self._R_level_base = T_odom_base[:3, :3]
        self._R_level_base = self._R_level_base @ turn @ se3.so3_exp(-duration_s * self._bias_radps)
        measured, time_s = up_by(observation.accelerometer_base), _BY_GRAVITY_S
        if measured is None and T_odom_base is not None:
            measured, time_s = T_odom_base[2, :3], _BY_ODOMETRY_S
            if np.linalg.norm(np.cross(measured, self._R_level_base[2])) > _SLOPE_SIN:
                measured = None
        if measured is not None:
            off, share = np.cross(measured, self._R_level_base[2]), min(duration_s / time_s, 1.0)
            self._R_level_base = self._R_level_base @ se3.so3_exp(share * off)
            self._bias_radps = self._bias_radps - share / (4.0 * time_s) * off  # damped critically
        return np.asarray(self._R_level_base[2])
