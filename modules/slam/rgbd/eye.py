"""From an observation to its features, as a camera would see them that reads all rows at once."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .features import FeatureExtractor
from .localizer import Fix
from .shutter import RollingShutter
from .view import View

_ROW_STEP = 32  # rows that are compared first


class Eye:
    """Finds features and straightens them; learns how from the poses that they led to."""

    def __init__(self, camera: Camera, extractor: FeatureExtractor) -> None:
        self._rotation_cam_base = camera.T_base_cam[:3, :3].T
        self._extractor, self._shutter = extractor, RollingShutter(camera)
        self._rate_cam = np.zeros(3)  # [rad/s], while the last image was read
        self._last_bgr: NDArray[np.uint8] | None = None

    def is_repeated(self, image_bgr: NDArray[np.uint8]) -> bool:
        """Tell whether an image is the last one again, to the bit: a sensor's noise never is.

        Then the camera hangs, or what brings its images does, and nothing was measured.
        """
        last, self._last_bgr = self._last_bgr, image_bgr
        if last is None or not np.array_equal(last[::_ROW_STEP], image_bgr[::_ROW_STEP]):
            return False
        return np.array_equal(last, image_bgr)

    def look(
        self,
        observation: Observation,
        image_bgr: NDArray[np.uint8],
        *,
        T_predicted: Transform,
        rate_base: NDArray[np.float64],
    ) -> View:
        """Return what an image shows, taken while the base turned by (3,) [rad/s]."""
        gray = np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        features = self._extractor.extract(gray, observation.depth_m)
        self._rate_cam = self._rotation_cam_base @ rate_base
        features = self._shutter.straighten(features, self._rate_cam)
        return View(
            observation=observation,
            image_bgr=image_bgr,
            gray=gray,
            features=features,
            T_predicted=T_predicted,
        )

    def learn(self, view: View, fix: Fix) -> None:
        """Hear of the pose that the last view led to."""
        uv_px = view.features.uv_px[fix.feature_rows]
        self._shutter.learn(fix.estimate.linearised, uv_px, self._rate_cam)
