"""Motions in the plane as vectors (3,): x [m], y [m], yaw [rad]."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

Planar = NDArray[np.float64]  # (3,)
Matrix = NDArray[np.float64]  # (3, 3), covariance or information of a Planar
_PLANAR, _LEVEL = [0, 1, 5], [2, 3, 4]  # x, y, yaw; z, roll, pitch; in se3.log order


def to_transform(pose: Planar) -> se3.Transform:
    """Return the (4, 4) transform of a planar one."""
    return se3.from_xy_yaw(float(pose[0]), float(pose[1]), float(pose[2]))


def from_transform(T_a_b: se3.Transform) -> Planar:
    """Return the planar part (3,), x, y [m], yaw [rad], of a transform (4, 4)."""
    return np.array([T_a_b[0, 3], T_a_b[1, 3], se3.yaw_rad(T_a_b)])


def from_transforms(T_a_b: Sequence[se3.Transform] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the planar parts (N, 3), x, y [m], yaw [rad], of transforms (N, 4, 4)."""
    return np.array([from_transform(T) for T in T_a_b]).reshape(-1, 3)


def compose(T_a_b: Planar, T_b_c: Planar) -> Planar:
    """Return T_a_c."""
    c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    x, y, yaw = T_b_c
    return np.array([T_a_b[0] + c * x - s * y, T_a_b[1] + s * x + c * y, wrap(T_a_b[2] + yaw)])


def between(T_a_b: Planar, T_a_c: Planar) -> Planar:
    """Return T_b_c."""
    c, s = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    x, y = T_a_c[:2] - T_a_b[:2]
    return np.array([c * x + s * y, -s * x + c * y, wrap(T_a_c[2] - T_a_b[2])])


def wrap(angle_rad: float) -> float:
    """Return the angle in [-pi, pi)."""
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def rotation(yaw_rad: float) -> NDArray[np.float64]:
    """Return the (2, 2) rotation."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def apply(T_a_b: Planar, points_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (N, 2) of b in a."""
    return np.asarray(points_b @ rotation(T_a_b[2]).T + T_a_b[:2])


def propagate(covariance: Matrix, T_a_b: Planar, T_b_c: Planar, noise: Matrix) -> Matrix:
    """Return the covariance of T_a_c (axes of a) from that of T_a_b and `noise` of T_b_c (of b)."""
    x, y = rotation(T_a_b[2]) @ T_b_c[:2]
    F = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    G = turn(T_a_b[2])
    return np.asarray(F @ covariance @ F.T + G @ noise @ G.T)


def turn(yaw_rad: float) -> Matrix:
    """Return the (3, 3) matrix that rotates x and y of a motion and keeps its yaw."""
    G = np.eye(3)
    G[:2, :2] = rotation(yaw_rad)
    return G


def planar_covariance(covariance: NDArray[np.float64]) -> Matrix:
    """Return the planar part of a (6, 6) covariance of se3.log order."""
    return np.asarray(covariance[np.ix_(_PLANAR, _PLANAR)])


def spatial_covariance(
    covariance: Matrix, level: float | NDArray[np.float64] = 0.0
) -> NDArray[np.float64]:
    """Return the (6, 6) covariance of se3.log order; `level`: variances (3,) of z, roll, pitch."""
    spatial = np.zeros((6, 6))
    spatial[_LEVEL, _LEVEL] = level
    spatial[np.ix_(_PLANAR, _PLANAR)] = covariance
    return spatial
