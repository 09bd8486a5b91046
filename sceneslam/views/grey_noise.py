"""The noise of grey images, and dark ones made as bright as it allows."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.spread import spread

_DARK = 128.0  # grey level of the brightest per cent of the pixels
_SMOOTH_PX = 1.0  # standard deviation of the filter ...
_LEFT = 0.28  # ... and share of white noise that it leaves: 1 / (2 sqrt(pi)) for one pixel
_NOISE_LEAST = 1.0  # grey level: the median of less is 0 in most images


def grey_noise(grey: NDArray[np.uint8]) -> float:
    """Return the standard deviation [grey levels] of an image's noise.

    It is the median response of a Laplacian, whose gain on white noise is sqrt(20).
    """
    response = 4 * grey[4:-4:8, 4:-4:8].astype(np.int16)
    for row, column in ((3, 4), (5, 4), (4, 3), (4, 5)):
        response -= grey[row : row - 8 : 8, column : column - 8 : 8]
    return spread(response) / float(np.sqrt(20.0))


def brightened(grey: NDArray[np.uint8], *, noise_max: float) -> NDArray[np.uint8]:
    """Return a dark image (H, W) smoothed, and brighter.

    Its contrast is that of a bright image, or as much as keeps its noise below `noise_max`.
    """
    brightest = float(np.percentile(grey[::4, ::4], 99.0))
    if brightest >= _DARK:
        return grey
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SMOOTH_PX)
    noise = _LEFT * max(grey_noise(grey), _NOISE_LEAST)
    gain = min(255.0 / max(brightest, 1.0), noise_max / noise)
    return np.asarray(np.clip(np.rint(smooth * max(gain, 1.0)), 0.0, 255.0), np.uint8)
