"""Match corners by their descriptors."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_RATIO = 0.8  # of the best match's distance to the second's (Lowe, IJCV 2004)


def matches(
    first: NDArray[np.uint8], second: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of two sets of descriptors (N, 32) that look like the same corners."""
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first, second, k=2)
    good = [pair[0] for pair in pairs if pair[0].distance < _RATIO * pair[-1].distance]
    best = {match.trainIdx: match for match in sorted(good, key=lambda one: -one.distance)}
    rows = np.array([match.queryIdx for match in best.values()], np.int64)
    return rows, np.array(list(best), np.int64)
