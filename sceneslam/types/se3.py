"""Rigid transforms as 4x4 float64 matrices: `T_a_b` takes b coordinates to a."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Transform = NDArray[np.float64]  # (4, 4), rigid
Vector = NDArray[np.float64]

_SMALLEST_RAD = 1e-4  # below, the series' factors are constant to 1e-9
_AXES = np.stack([np.cross(np.eye(3), axis) for axis in np.eye(3)]).reshape(3, 9)  # of `hat`


def _outer_of_rotation() -> NDArray[np.float64]:
    """Return M (9, 16): for a unit quaternion q (x, y, z, w) of R, 4 q q' = R M + I.

    As R = M q q', it leads both ways (Shepperd, "Quaternion from rotation matrix", 1978).
    """
    M = np.zeros((3, 3, 4, 4))
    for i, (j, k) in enumerate([(1, 2), (2, 0), (0, 1)]):
        M[i, i, [i, j, k, 3], [i, j, k, 3]] = 1, -1, -1, 1
        M[i, j, [i, j], [j, i]] = M[j, i, [i, j], [j, i]] = 1
        M[k, j, [i, 3], [3, i]], M[j, k, [i, 3], [3, i]] = 1, -1
    return M.reshape(9, 16)


_OUTER_OF_ROTATION = _outer_of_rotation()


def identity() -> Transform:
    """Return the identity transform (4, 4)."""
    return np.eye(4)


def from_parts(rotation: NDArray[np.float64], translation_m: NDArray[np.float64]) -> Transform:
    """Return T (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3) [m]."""
    T_a_b = np.zeros((*rotation.shape[:-2], 4, 4))
    T_a_b[..., :3, :3], T_a_b[..., :3, 3], T_a_b[..., 3, 3] = rotation, translation_m, 1.0
    return T_a_b


def from_xy_yaw(x_m: float, y_m: float, yaw_rad: float) -> Transform:
    """Return the transform (4, 4) of a planar motion: x, y [m], yaw [rad]."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T_a_b = np.eye(4)
    T_a_b[:2, :2] = [[c, -s], [s, c]]
    T_a_b[:2, 3] = x_m, y_m
    return T_a_b


def yaw_rad(T_a_b: Transform) -> float:
    """Return the rotation about z [rad] (REP-103: x forward, z up); T_a_b may be (3, 3), too."""
    return float(np.arctan2(T_a_b[1, 0], T_a_b[0, 0]))


def with_yaw(T_a_b: Transform, rad: float) -> Transform:
    """Return T_a_b (4, 4) with the same translation, roll and pitch, and another yaw."""
    return T_a_b @ from_xy_yaw(0.0, 0.0, rad - yaw_rad(T_a_b))


def inverse(T_a_b: Transform) -> Transform:
    """Return T_b_a; works on a stack (..., 4, 4) too."""
    rotation_t = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = rotation_t
    T_b_a[..., :3, 3:] = -rotation_t @ T_a_b[..., :3, 3:]
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def apply(T_a_b: Transform, points_b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return points (N, 3) of b in a, in the points' own dtype."""
    rotation = T_a_b[:3, :3].astype(points_b.dtype)
    return np.asarray(points_b @ rotation.T + T_a_b[:3, 3].astype(points_b.dtype))


def rotation_angle_rad(T_a_b: Transform) -> NDArray[np.float64]:
    """Return the angle of the rotation in [0, pi]; works on a stack (..., 4, 4).

    From sine and cosine together, which stays exact for angles near 0 and pi.
    """
    r = T_a_b[..., :3, :3].reshape(*T_a_b.shape[:-2], 9)
    twice_sine = np.linalg.norm(r[..., [7, 2, 3]] - r[..., [5, 6, 1]], axis=-1)
    return np.asarray(np.arctan2(twice_sine, r[..., ::4].sum(axis=-1) - 1.0))


def is_within(T_a_b: Transform, shift_m: float, turn_rad: float) -> bool:
    """Tell whether a transform (4, 4) shifts and turns by no more than this."""
    is_near = np.linalg.norm(T_a_b[:3, 3]) <= shift_m
    return bool(is_near and rotation_angle_rad(T_a_b) <= turn_rad)


def hat(v: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the (..., 3, 3) matrices whose products with x are the cross products v x x."""
    return np.asarray(v @ _AXES).reshape(*v.shape, 3)


def so3_exp(rotvec_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (..., 3, 3) rotations by the vectors (..., 3) [rad] (Rodrigues)."""
    angle = np.maximum(np.linalg.norm(rotvec_rad, axis=-1), 1e-8)[..., None, None]
    k = hat(rotvec_rad)
    a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + a * k + b * k @ k)


def so3_log(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vectors (..., 3) [rad] of (..., 3, 3) rotations."""
    quat = to_quat_xyzw(rotation)
    sine = np.linalg.norm(quat[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quat[..., 3:])
    return np.asarray(quat[..., :3] * (angle / np.maximum(sine, np.finfo(float).tiny)))


def exp(xi: NDArray[np.float64]) -> Transform:
    """Return the transform of the twist (6,): translation [m] first, then rotation [rad].

    The series of the matrix exponential, which the generator's fourth power closes.
    """
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = hat(xi[3:]), xi[:3]
    square = generator @ generator
    angle = max(math.sqrt(xi[3:] @ xi[3:]), _SMALLEST_RAD)
    b = (1.0 - math.cos(angle)) / angle**2
    c = (angle - math.sin(angle)) / angle**3
    return np.asarray(np.eye(4) + generator + b * square + c * (square @ generator))


def log(T_a_b: Transform) -> NDArray[np.float64]:
    """Return the twist (..., 6) of transforms: translation [m] first, then rotation [rad].

    The translation is by the closed inverse of the left Jacobian of SO(3) (Barfoot, "State
    Estimation for Robotics", 2017, Eq. 7.37).
    """
    phi = so3_log(T_a_b[..., :3, :3])
    half = 0.5 * np.maximum(np.linalg.norm(phi, axis=-1), _SMALLEST_RAD)[..., None, None]
    shift = T_a_b[..., :3, 3:]
    across = hat(phi) @ shift
    share = (1.0 - half / np.tan(half)) / (4.0 * half**2)
    rho = shift - 0.5 * across + share * (hat(phi) @ across)
    return np.concatenate([rho[..., 0], phi], axis=-1)


def adjoint(T_a_b: Transform) -> NDArray[np.float64]:
    """Return the (..., 6, 6) matrices that take twists of b to a (translation first)."""
    rotation = T_a_b[..., :3, :3]
    adjoint_a_b = np.zeros((*T_a_b.shape[:-2], 6, 6))
    adjoint_a_b[..., :3, :3] = adjoint_a_b[..., 3:, 3:] = rotation
    adjoint_a_b[..., :3, 3:] = hat(T_a_b[..., :3, 3]) @ rotation
    return adjoint_a_b


def carried(covariance: NDArray[np.floating], T_a_b: Transform) -> NDArray[np.float64]:
    """Return the covariances (..., 6, 6) of a frame a that is rigidly connected to b, from b's."""
    carry = adjoint(T_a_b)
    return np.asarray(carry @ covariance @ np.swapaxes(carry, -1, -2))


def mean(
    T_a_b: Sequence[Transform], covariances: Sequence[NDArray[np.float64]]
) -> tuple[Transform, NDArray[np.float64]]:
    """Return the mean of poses (4, 4), weighted by their information, and its covariance (6, 6).

    It is as certain as one of them, since they share their errors. Covariances are of `log` order,
    in b's axes; the poses are near each other.
    """
    offs = log(inverse(T_a_b[0]) @ np.array(T_a_b))
    weights = np.linalg.inv(covariances)
    spread = np.linalg.inv(weights.sum(axis=0))
    return T_a_b[0] @ exp(spread @ np.einsum("nij,nj->i", weights, offs)), len(T_a_b) * spread


def interpolate(
    T_w_0: Transform, T_w_1: Transform, ratio: float | NDArray[np.float64]
) -> Transform:
    """Return the poses (..., 4, 4) at `ratio` (...) between T_w_0 and T_w_1 (linear, slerp)."""
    share, R_w_0 = np.asarray(ratio)[..., None], T_w_0[..., :3, :3]
    step = so3_log(np.swapaxes(R_w_0, -1, -2) @ T_w_1[..., :3, :3])
    shift_m = (1.0 - share) * T_w_0[..., :3, 3] + share * T_w_1[..., :3, 3]
    return from_parts(R_w_0 @ so3_exp(share * step), shift_m)


def from_quat_xyzw(translation_m: NDArray[np.float64], quat_xyzw: NDArray[np.float64]) -> Transform:
    """Return T from (..., 3) translations [m] and (..., 4) quaternions, normalised here."""
    q = quat_xyzw / np.linalg.norm(quat_xyzw, axis=-1, keepdims=True)
    outer = (q[..., :, None] * q[..., None, :]).reshape(-1, 16)
    T_a_b = np.zeros((*q.shape[:-1], 4, 4))
    T_a_b[..., :3, :3] = (outer @ _OUTER_OF_ROTATION.T).reshape(*q.shape[:-1], 3, 3)
    T_a_b[..., :3, 3] = translation_m
    T_a_b[..., 3, 3] = 1.0
    return T_a_b


def to_quat_xyzw(T_a_b: Transform) -> NDArray[np.float64]:
    """Return unit quaternions (..., 4) with w >= 0 of transforms (..., 4, 4)."""
    shape = T_a_b.shape[:-2]
    outer = T_a_b[..., :3, :3].reshape(-1, 9) @ _OUTER_OF_ROTATION
    outer[:, ::5] += 1.0
    # Each row is the quaternion times one of its components; the largest is the stable one.
    best = np.argmax(outer[:, ::5], axis=1)
    quat = outer.reshape(-1, 4, 4)[np.arange(len(outer)), best]
    quat /= np.linalg.norm(quat, axis=1, keepdims=True) * np.where(quat[:, 3:] < 0, -1.0, 1.0)
    return np.asarray(quat.reshape(*shape, 4))


def chained(T_a_b: Transform, T_b_c: Transform) -> Transform:
    """Return T_a_c, in which no rounding adds up however many transforms are chained.

    One step of Newton's iteration to the nearest rotation (Higham, "Computing the polar
    decomposition", 1986): what is off by e comes out off by e^2.
    """
    T_a_c = T_a_b @ T_b_c
    rotation = T_a_c[:3, :3]
    T_a_c[:3, :3] = 1.5 * rotation - 0.5 * rotation @ (rotation.T @ rotation)
    return np.asarray(T_a_c)


def skew(T_a_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much (...) transforms (..., 4, 4) are no rotations; inf for reflections.

    It is the largest entry of |R^T R - I|.
    """
    R = T_a_b[..., :3, :3]
    off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-2, -1))
    return np.asarray(np.where(np.linalg.det(R) < 0, np.inf, off))


def orthonormal(T_a_b: Transform) -> Transform:
    """Return the transform (4, 4) with an exactly orthonormal rotation."""
    return from_quat_xyzw(T_a_b[..., :3, 3], to_quat_xyzw(T_a_b))
