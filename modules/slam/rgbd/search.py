"""The order in which the camera is looked for: where it should be, near there, anywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .localizer import Fix, Localizer
from .relocalizer import Relocalizer
from .view import View


class Search:
    """Finds the camera in the map, by the cheapest way that succeeds."""

    def __init__(self, localizer: Localizer, relocalizer: Relocalizer) -> None:
        self._localizer, self._relocalizer = localizer, relocalizer

    def find(self, view: View, held_ids: NDArray[np.int64], *, is_lost: bool) -> Fix | None:
        """Return the pose of a view; what was held last is worth less if lost."""
        fix = self._localizer.near(view.features, view.T_predicted, held_ids)
        if fix is None and not is_lost:
            fix = self._localizer.around(view.features, held_ids)
        return fix or self._relocalizer.find(view.features, view.depth_m)
