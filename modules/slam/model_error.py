"""Errors of a camera's model: how residuals show them, and how they grow with motion.

Wrong intrinsics, a shutter that reads row by row and stamps that are late leave residuals that no
noise explains, and errors in proportion to how far the camera moved and turned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import covariance_of
from sceneslam.types.se3 import Transform

_RATIO = 0.03  # of a motion, mainly by wrong intrinsics
_KEPT = 0.95  # smoothing from image to image
_NOT_HELD = 1e-9  # share of all information, added to every direction


class Smoothed:
    """A figure of single images, smoothed over them."""

    def __init__(self) -> None:
        self.value: float | None = None

    def follow(self, now: float) -> float:
        """Return the figure, with that of one more image in it; the first counts in full."""
        before = now if self.value is None else self.value
        self.value = _KEPT * before + (1.0 - _KEPT) * now
        return self.value


def summed(pulls: NDArray[np.floating], blocks: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the sums (6, B) of residuals' pulls (6, N) on a pose by block (N,), 0 and above."""
    return np.stack([np.bincount(blocks, row) for row in pulls])


def squared(pulls: NDArray[np.floating], information: NDArray[np.float64]) -> float:
    """Return the squares of pulls (6, N) in units of what independent residuals do: 6 in all.

    Of sums by block it is the trace of a cluster-robust covariance (Liang and Zeger 1986) over that
    by `information` (6, 6).
    """
    # Residuals alone do not constrain every pose, e.g. corners on a line; rounding goes below 0.
    spare = _NOT_HELD * float(np.trace(information))
    covariance = covariance_of(information + spare * np.eye(6), unmeasured=spare)
    return float(np.einsum("in,ij,jn->", pulls, covariance, pulls, optimize=True))


def motion_covariance(
    T_first_second: Transform, measured: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a measured covariance (6, 6) plus model errors in proportion to the motion.

    Works on stacks (..., 4, 4) too.
    """
    moved2 = (T_first_second[..., :3, 3] ** 2).sum(axis=-1)
    turned2 = se3.rotation_angle_rad(T_first_second) ** 2
    variances = _RATIO**2 * np.stack([moved2, turned2], axis=-1)
    return np.asarray(measured + variances.repeat(3, axis=-1)[..., None] * np.eye(6))


def model_covariance(T_keyframe_here: NDArray[np.float64], away2_m2: float) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a pose by the motions (K, 4, 4) from the keyframes around.

    A shift makes up for a wrong turn, in proportion to the squared distance `away2_m2` of what is
    seen.
    """
    covariance = motion_covariance(T_keyframe_here, np.zeros((6, 6))).mean(axis=0)
    covariance[:3, :3] += away2_m2 * covariance[3:, 3:]
    return np.asarray(covariance)
