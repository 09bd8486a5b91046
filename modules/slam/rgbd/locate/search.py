"""Search the camera's pose: at the prediction, then near it, then anywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..see.view import View
from .localizer import VisualFix, VisualLocalizer
from .relocalizer import Relocalizer

_CLEAR_RATIO = 0.2  # of the expected landmarks; up to 0.12 were observed by chance


class Search:
    """Finds the camera in the map by the cheapest method that succeeds clearly."""

    def __init__(self, localizer: VisualLocalizer, relocalizer: Relocalizer) -> None:
        self._localizer, self._relocalizer = localizer, relocalizer

    def find(self, view: View, held_ids: NDArray[np.int64], *, is_lost: bool) -> VisualFix | None:
        """Return the pose of a view; `held_ids` (N,) are the landmarks tracked last.

        If the prediction is far off, similar landmarks around it may agree by chance: then the
        correct pose has more inliers.
        """
        fix = self._localizer.near(view.features, view.T_predicted, held_ids)
        if fix is not None and fix.found_ratio(view.features) >= _CLEAR_RATIO:
            return fix
        if fix is not None or not is_lost:
            fix = _better(fix, self._localizer.around(view.features, held_ids))
        return fix or self._relocalizer.find(view.features, view.depth_m)


def _better(one: VisualFix | None, other: VisualFix | None) -> VisualFix | None:
    """Return the pose with more inliers."""
    if one is None or other is None:
        return one or other
    return other if len(other.landmark_ids) > len(one.landmark_ids) else one
