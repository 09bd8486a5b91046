"""Finds the camera again after it was lost, wherever in the map it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .features import Features
from .keyframes import KeyframeStore
from .localizer import Fix
from .recognition import PlaceRecognizer

_ALIKE = 3  # keyframes tried per image
_RECENT = 1  # and the latest, whatever they look like


class Relocalizer:
    """Tries the keyframes that look most like the image."""

    def __init__(self, keyframes: KeyframeStore, recognizer: PlaceRecognizer) -> None:
        self._keyframes, self._recognizer = keyframes, recognizer

    def find(self, features: Features, depth_m: NDArray[np.float32] | None) -> Fix | None:
        """Return the pose in the map, None when no keyframe confirms one."""
        if not len(features):
            return None
        alike = self._recognizer.places.alike(features.descriptors)[:_ALIKE]
        recent = self._keyframes.ids[-_RECENT:]
        for keyframe_id in dict.fromkeys([likeness.place_id for likeness in alike] + recent):
            seen = self._recognizer.recognize(keyframe_id, features, depth_m)
            if seen is not None:
                return seen.fix
        return None
