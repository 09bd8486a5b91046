"""Covariances that stay positive, also where a direction is not measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

Matrix = NDArray[np.float64]

UNKNOWN_VELOCITY = np.array([1.0, 2.0])  # m/s, rad/s: standard deviations, of robots and by hand
_UPPER = np.triu_indices(6)
TRIANGLE = len(_UPPER[0])  # values in the upper triangle of a covariance (6, 6)
_ANY_RAD = np.pi / np.sqrt(3.0)  # standard deviation of an angle that may be any


def covariance_of(information: Matrix, *, unmeasured: float) -> Matrix:
    """Return the inverse of a symmetric information (N, N), of which `unmeasured` is the least.

    By its eigenvalues, since rounding leaves some below 0 where nothing is measured.
    """
    values, vectors = np.linalg.eigh(information)
    return np.asarray((vectors / np.maximum(values, unmeasured)) @ vectors.T)


def triangle(matrices: Matrix) -> Matrix:
    """Return the upper triangles (..., 21), row by row, of matrices (..., 6, 6)."""
    return matrices[..., *_UPPER]


def symmetric(triangles: Matrix) -> Matrix:
    """Return the symmetric matrices (..., 6, 6) of upper triangles (..., 21)."""
    matrices = np.empty((*triangles.shape[:-1], 6, 6))
    matrices[..., *_UPPER] = matrices[..., *_UPPER[::-1]] = triangles
    return matrices


def semidefinite(matrices: Matrix) -> Matrix:
    """Return symmetric matrices (..., N, N) without their negative parts."""
    values, vectors = np.linalg.eigh(matrices)
    scaled = vectors * np.maximum(values, 0.0)[..., None, :]
    return np.asarray(scaled @ np.swapaxes(vectors, -1, -2))


def unknown_motion(lost_s: float) -> Matrix:
    """Return the covariance (6, 6) [m, rad] of the motion in a time of which nothing is known."""
    deviations = np.minimum(UNKNOWN_VELOCITY * lost_s, [np.inf, _ANY_RAD])
    return np.diag(np.repeat(deviations, 3)) ** 2


def grown(first: Matrix, last: Matrix, T_last_first: Transform) -> Matrix:
    """Return the growth (6, 6) of a covariance between two poses of one map, in the last's axes."""
    return semidefinite(last - se3.carried(first, T_last_first))


def updated(before: Matrix, gain: Matrix, seen: Matrix, noise: Matrix) -> Matrix:
    """Return the covariance (N, N) after a measurement of `seen` (K, N) with its noise (K, K).

    Joseph's form (Bucy and Joseph 1968): no rounding makes it negative. `gain` is (N, K).
    """
    left = np.eye(len(before)) - gain @ seen
    return np.asarray(left @ before @ left.T + gain @ noise @ gain.T)
