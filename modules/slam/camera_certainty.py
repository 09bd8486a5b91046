"""The covariance of a tracked pose, including errors beyond the noise of its points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from .model_error import Smoothed, model_covariance

CORRELATION = 100.0  # correlated points or pixels with the information of one
_EXPLAINED = 1.0  # mean square of residuals [sigma^2] that noise explains: 0.1 to 0.3 in
# simulations, 2.3 to 6.7 on freiburg1_rpy, 1.2 to 6.9 on RedKitchen


class CameraCertainty:
    """How much residuals have in common, and whether noise explains them, over the images."""

    def __init__(self, T_base_cam: se3.Transform) -> None:
        self._T_base_cam = T_base_cam
        self._common, self._misfit = Smoothed(), Smoothed()
        self._ratio, self._model = 1.0, np.zeros((6, 6))

    def follow(
        self,
        *,
        common_ratio: float,
        misfit: float,
        T_keyframe_cam: NDArray[np.float64],
        away2_m2: float,
    ) -> None:
        """Learn from an image: residuals that pull more than `CORRELATION` are no noise.

        Where their mean square `misfit` [sigma^2] is larger than noise, the camera's model is
        wrong, and a share of the motion (K, 4, 4) from the keyframes is an error; `away2_m2` is
        the squared distance of what is seen.
        """
        self._ratio = max(1.0, self._common.follow(common_ratio) / CORRELATION)
        share = float(np.clip(self._misfit.follow(misfit) - _EXPLAINED, 0.0, 1.0))
        model = share * model_covariance(T_keyframe_cam, away2_m2)
        self._model = se3.carried(model, self._T_base_cam)

    def covariance(self, tracked: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a pose beside the map, in base, by that of tracking."""
        return np.asarray(self._ratio * tracked + self._model)
