"""Rays of a camera, and where two of them come closest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_PARALLEL = 1e-12  # of the determinant: parallel rays meet far away


def directions(rays: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the directions (N, 3) of rays (N, 2), x / z and y / z in the camera frame."""
    return np.column_stack([rays.astype(float), np.ones(len(rays))])


def closest(
    a: NDArray[np.float64], b: NDArray[np.float64], way: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far (N,) along rays `a`, and `b`, (N, 3) two of them come closest to each other.

    In units of their lengths; `way` (3,) leads from where rays `a` begin to where rays `b` do.
    """
    aa, ab, bb = (a * a).sum(1), (a * b).sum(1), (b * b).sum(1)
    determinant = np.maximum(aa * bb - ab**2, _PARALLEL)
    along_a = (bb * (a @ way) - ab * (b @ way)) / determinant
    along_b = (ab * (a @ way) - aa * (b @ way)) / determinant
    return along_a, along_b
