"""Finds the camera again after it was lost: keyframes that look alike are compared with it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .features import Features
from .keyframes import KeyframeStore
from .localizer import Fix, Localizer

_THUMBNAIL_WH = (40, 30)
_BLUR_PX = 1.5
_ALIKE = 3  # keyframes tried per image
_RECENT = 1  # of them, the latest whatever they look like


def appearance(gray: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return a blurred thumbnail of `gray` as a vector of zero mean and unit length."""
    small = cv2.resize(gray, _THUMBNAIL_WH, interpolation=cv2.INTER_AREA).astype(np.float32)
    vector = cv2.GaussianBlur(small, (0, 0), _BLUR_PX).ravel()
    vector = vector - vector.mean()
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-6), dtype=np.float32)


class Relocalizer:
    """Proposes keyframes by their thumbnails and lets descriptors and PnP decide."""

    def __init__(self, keyframes: KeyframeStore, localizer: Localizer, *, min_inliers: int) -> None:
        self._keyframes, self._localizer = keyframes, localizer
        self._min_inliers = min_inliers

    def find(self, features: Features, gray: NDArray[np.uint8]) -> Fix | None:
        """Return the pose in the map, None when no keyframe confirms one."""
        if len(features) < self._min_inliers:
            return None
        recent = self._keyframes.ids[-_RECENT:]
        alike = self._keyframes.alike(appearance(gray), limit=_ALIKE)
        for keyframe_id in dict.fromkeys(alike + recent):
            landmark_ids = self._keyframes.landmarks_of([keyframe_id])
            fix = self._localizer.anywhere(features, landmark_ids)
            if fix is not None and len(fix.landmark_ids) >= self._min_inliers:
                return fix
        return None
