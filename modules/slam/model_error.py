"""Errors of a camera's model, which grow with the motion between two views.

Wrong intrinsics, a shutter that reads row by row and stamps that are late leave residuals that no
noise explains, and errors in proportion to how far the camera moved and turned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_RATIO = 0.03  # of a motion, mainly by wrong intrinsics
_KEPT = 0.95  # smoothing from image to image


class Smoothed:
    """A figure of single images, smoothed over them."""

    def __init__(self) -> None:
        self.value: float | None = None

    def follow(self, now: float) -> float:
        """Return the figure, with that of one more image in it; the first counts in full."""
        before = now if self.value is None else self.value
        self.value = _KEPT * before + (1.0 - _KEPT) * now
        return self.value


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
