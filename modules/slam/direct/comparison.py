"""The agreement of two views at a pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import semidefinite
from sceneslam.types.spread import spread

from ..camera_certainty import CORRELATION
from ..model_error import squared, summed
from .view import DirectView, Tracker

Doubles = NDArray[np.float64]

_STEP_PX = 4  # distance between compared pixels
_DEPTH_NOISE = (0.003, 0.0015)  # sigma = a + b z^2 [m], structured light
_GATE_SIGMAS = 5.0  # larger differences of depth are other surfaces
_GREY_SIGMA_MIN = 3.0  # grey values: smallest image noise
_CELLS = 8  # per image width, in which residuals are summed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """The agreement of two views at a relative pose."""

    information: Doubles  # (6, 6) of se3.log order, cam
    misfit: float  # negative logarithm of the likelihood, per pixel
    common_ratio: float = 1.0  # by how much residuals pull more than independent ones
    deeper_square: float = 0.0  # mean square of the differences of depth [sigma^2]
    away2_m2: float = 0.0  # squared distance of what is seen, median
    compared: int  # pixels with depth in both views
    matched: int  # of these, on the same surface

    @property
    def matched_ratio(self) -> float:
        """Return the share of compared pixels that agree."""
        return self.matched / max(self.compared, 1)


def compare(
    tracker: Tracker, view: DirectView, other: DirectView, T_other_view: se3.Transform
) -> Comparison:
    """Return the agreement of two views at T_other_view (4, 4) [m]."""
    # Project the view's points into the other image.
    K = tracker.K
    points_view = tracker.points(view, _STEP_PX).astype(np.float64)
    greys = view.grey[::_STEP_PX, ::_STEP_PX].reshape(-1).astype(np.float64)
    points = np.asarray(se3.apply(T_other_view, points_view), np.float64)
    z = np.maximum(points[:, 2], 1e-6)
    pixels = points[:, :2] / z[:, None] * [K[0, 0], K[1, 1]] + K[:2, 2]
    place = np.rint(pixels).astype(np.int64)
    height, width = other.grey.shape
    inside = (points_view[:, 2] > 0) & (points[:, 2] > 0)
    inside &= (place >= 1).all(axis=1) & (place < [width - 1, height - 1]).all(axis=1)
    column, row = np.where(inside[:, None], place, 1).T
    inside &= other.depth_m[row, column] > 0
    rows = np.flatnonzero(inside)
    row, column, z = row[rows], column[rows], z[rows]
    slopes = _slopes(other, row, column)
    beside = np.einsum("nij,nj->ni", slopes, pixels[rows] - place[rows])
    # Points match where the other depth agrees within its noise.
    sigma_m = _DEPTH_NOISE[0] + _DEPTH_NOISE[1] * z**2
    deeper = (other.depth_m[row, column] + beside[:, 1] - z) / sigma_m
    matched = np.abs(deeper) < _GATE_SIGMAS
    compared = len(rows)
    if not matched.any():
        nothing = np.zeros((6, 6))
        return Comparison(information=nothing, misfit=np.inf, compared=compared, matched=0)
    apart = _squared(deeper)
    rows, deeper, sigma_m = rows[matched], deeper[matched], sigma_m[matched]
    row, column, slopes = row[matched], column[matched], slopes[matched]
    brighter = other.grey[row, column] + beside[matched, 0] - greys[rows]
    brighter = brighter - np.median(brighter)  # exposure
    # Noise of grey values, by the differences.
    noise = spread(brighter)
    grey_sigma = max(noise, _GREY_SIGMA_MIN)
    # Derivatives of both residuals, grey(pixel) and depth(pixel) - z, over their sigmas
    # (Steinbruecker et al., ICCVW 2011); the information is J' J.
    jacobians = _jacobians(points_view[rows], T_other_view, points[rows], K)
    photometric = np.einsum("ni,nij->nj", slopes[:, 0], jacobians[:, :2]) / grey_sigma
    geometric = np.einsum("ni,nij->nj", slopes[:, 1], jacobians[:, :2]) - jacobians[:, 2]
    geometric /= sigma_m[:, None]
    # A slope is half a difference of two greys, and so has half the variance of their noise, a
    # quarter of that of `brighter`: by it, darkness would say where it is.
    by_noise = 0.5 * noise / grey_sigma * jacobians[:, :2].reshape(-1, 6)
    by_grey, by_depth = photometric.T @ photometric, geometric.T @ geometric
    seen = semidefinite(by_grey - by_noise.T @ by_noise)
    pulls = (photometric * (brighter / grey_sigma)[:, None] + geometric * deeper[:, None]).T
    side_px = -(-width // _CELLS)
    blocks = row // side_px * _CELLS + column // side_px
    return Comparison(
        information=(seen + by_depth) / CORRELATION,
        misfit=float(np.log(grey_sigma) + 0.5 * (_squared(brighter / grey_sigma) + apart)),
        compared=compared,
        matched=len(rows),
        common_ratio=squared(summed(pulls, blocks), by_grey + by_depth) / 6.0,
        deeper_square=_squared(deeper),
        away2_m2=float(np.median((points_view[rows] ** 2).sum(axis=1))),
    )


def _squared(sigmas: Doubles) -> float:
    """Return the mean square of errors (N,) in units of their deviations, gross ones cut off."""
    return float(np.minimum(sigmas**2, _GATE_SIGMAS**2).mean())


def _jacobians(
    points_view: Doubles, T_other_view: se3.Transform, points: Doubles, K: Doubles
) -> Doubles:
    """Return (N, 3, 6): derivative of pixel and depth in the other view by the view's twist."""
    # Derivative of (u, v, z) by the point in the other camera: pinhole projection.
    x, y, z = points.T
    zero = np.zeros_like(z)
    projection = np.stack(
        [
            np.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2], axis=-1),
            np.stack([zero, K[1, 1] / z, -K[1, 1] * y / z**2], axis=-1),
            np.stack([zero, zero, np.ones_like(z)], axis=-1),
        ],
        axis=1,
    )
    # Derivative of the point by a twist on the right, T exp(xi): R (I, -[p]x).
    minus_hat = -se3.hat(points_view)
    moved = np.concatenate([np.broadcast_to(np.eye(3), minus_hat.shape), minus_hat], axis=2)
    return np.asarray(projection @ (T_other_view[:3, :3] @ moved))


def _slopes(view: DirectView, row: NDArray[np.int64], column: NDArray[np.int64]) -> Doubles:
    """Return (N, 2, 2): gradients of grey value and depth [m] along x and y [1/px], at pixels."""
    found = []
    for picture in (view.grey.astype(np.float64), view.depth_m.astype(np.float64)):
        along_x = 0.5 * (picture[row, column + 1] - picture[row, column - 1])
        along_y = 0.5 * (picture[row + 1, column] - picture[row - 1, column])
        found.append(np.stack([along_x, along_y], axis=-1))
    depth = view.depth_m
    around = [depth[row, column + d] for d in (-1, 1)] + [depth[row + d, column] for d in (-1, 1)]
    steps = np.ptp(np.stack([*around, depth[row, column]]), axis=0)
    found[1][steps > 0.05 * depth[row, column]] = 0.0  # an edge, or missing neighbours: no gradient
    return np.stack(found, axis=1)
