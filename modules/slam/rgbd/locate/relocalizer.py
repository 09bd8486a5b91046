"""Relocalize the camera anywhere in the map after tracking was lost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from ..map.keyframes import KeyframeStore
from ..see.features import Features
from .localizer import VisualFix
from .recognition import PlaceRecognizer

_ALIKE = 3  # keyframes tried per image
_RECENT = 1  # newest keyframes tried in any case
_RIVALS = 2  # other places tried, which must not be confirmed as well
_SAME_M = 0.3  # parts of a map with drift may differ this much at one place
_SAME_RAD = 0.2
_AWAY_M = 1.0  # farther keyframes show another place
_AWAY_RAD = 0.7


class Relocalizer:
    """Tries the keyframes most similar to the image; rejects ambiguous places."""

    def __init__(self, keyframes: KeyframeStore, recognizer: PlaceRecognizer) -> None:
        self._keyframes, self._recognizer = keyframes, recognizer

    def find(self, features: Features, depth_m: NDArray[np.float32] | None) -> VisualFix | None:
        """Return T_local_base in the map, None if no place or more than one is confirmed."""
        if not len(features):
            return None
        alike = [found.place_id for found in self._recognizer.places.alike(features.descriptors)]
        recent = self._keyframes.ids[-_RECENT:]
        for keyframe_id in dict.fromkeys(alike[:_ALIKE] + recent):
            fix = self._recognizer.recognize(keyframe_id, features, depth_m)
            if fix is not None:
                rivals = self._rivals(fix, alike)
                others = [self._recognizer.recognize(k, features, depth_m) for k in rivals]
                is_clear = all(other is None or _is_same_place(fix, other) for other in others)
                return fix if is_clear else None
        return None

    def _rivals(self, fix: VisualFix, alike: list[int]) -> list[int]:
        """Return the most similar keyframes that were taken elsewhere."""
        here = fix.estimate.T_local_base
        poses = {k: self._keyframes[k].T_local_base for k in alike}
        away = {k: se3.inverse(here) @ T for k, T in poses.items()}
        return [k for k, T in away.items() if not se3.is_within(T, _AWAY_M, _AWAY_RAD)][:_RIVALS]


def _is_same_place(one: VisualFix, other: VisualFix) -> bool:
    T_local_base, T_other = (fix.estimate.T_local_base for fix in (one, other))
    return se3.is_within(se3.inverse(T_local_base) @ T_other, _SAME_M, _SAME_RAD)
