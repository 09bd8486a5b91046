"""The covariance of a registration, including errors beyond the noise of its points."""

from __future__ import annotations

import numpy as np

from sceneslam.types.covariance import covariance_of

from ..model_error import Smoothed, model_covariance
from ..surfaces.registration import Samples, SurfaceRegistration
from ..surfaces.surface import Doubles

_UNMEASURED = 0.01  # 1/m^2, 1/rad^2: information where the surfaces hold nothing
_BESIDE_WHEELS = 100.0  # least common ratio there: images in a row err in the same way, too
_EXPLAINED = 1.0  # mean square of residuals [sigma^2] that noise explains: 0.1 to 0.3 in
# simulations, 2.3 to 6.7 on freiburg1_rpy, 1.2 to 6.9 on RedKitchen


class Certainty:
    """How much residuals have in common, and whether noise explains them, over the images."""

    def __init__(self) -> None:
        self._common, self._misfit = Smoothed(), Smoothed()
        self._least = 1.0

    @property
    def common_ratio(self) -> float:
        """Return how many points have the information of one."""
        return max(self._least, self._common.value or 1.0)

    def follow(self, found: SurfaceRegistration, *, has_wheels: bool) -> None:
        """Learn from the registration of an image; `has_wheels`: they cover its motion."""
        self._common.follow(found.common_ratio)
        self._misfit.follow(found.misfit)
        self._least = _BESIDE_WHEELS if has_wheels else 1.0

    def covariance(self, found: SurfaceRegistration, samples: Samples) -> Doubles:
        """Return the covariance (6, 6) of a registered pose beside its keyframes, in cam.

        Where residuals are larger than noise, the camera's model is wrong, and a share of the
        motion from the keyframes is added.
        """
        away2_m2 = float(np.median((samples.points**2).sum(axis=1)))
        model = model_covariance(found.T_keyframe_cam, away2_m2)
        share = float(np.clip((self._misfit.value or 0.0) - _EXPLAINED, 0.0, 1.0))
        measured = covariance_of(found.information / self.common_ratio, unmeasured=_UNMEASURED)
        return np.asarray(measured + share * model)
