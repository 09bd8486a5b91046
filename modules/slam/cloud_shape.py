"""Localizability of clouds without normals, by planes in cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .clouds import Cloud
from .degeneracy import Localizability, localizability

_POINTS_MIN = 5  # of a cell
_WIDTH_MIN_RATIO = 0.05  # middle to largest variance; below, the points are a line of one beam


def cloud_localizability(cloud: Cloud, cell_m: float) -> Localizability:
    """Return how well points (N, 3) [m] constrain a pose, in the points' frame.

    A cell constrains the direction of its smallest variance: the normal if it is flat; a cell that
    is filled evenly has less weight. The points of a single beam are left out, since they move with
    the sensor.
    """
    means, covariances, counts = _cells(cloud, cell_m)
    variances, axes = np.linalg.eigh(covariances)
    wide = variances[:, 1] > _WIDTH_MIN_RATIO * variances[:, 2]
    flatness = 1.0 - variances[wide, 0] / np.maximum(variances[wide, 1], 1e-12)
    return localizability(means[wide], axes[wide, :, 0], counts[wide] * flatness**2)


def _cells(
    cloud: Cloud, cell_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return mean (M, 3), covariance (M, 3, 3) and number of points (M,) of cells with enough."""
    cells = np.floor(cloud / cell_m).astype(np.int64)
    keys = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=keys[order[0]] - 1))
    counts = np.diff(starts, append=len(keys)).astype(np.float64)
    points = cloud[order]
    squares = points[:, :, None] * points[:, None, :]
    enough = counts >= _POINTS_MIN
    number = counts[enough, None]
    means = np.add.reduceat(points, starts)[enough] / number
    moments = np.add.reduceat(squares.reshape(-1, 9), starts)[enough] / number
    covariances = moments.reshape(-1, 3, 3) - means[:, :, None] * means[:, None, :]
    return means, covariances, counts[enough]
