"""Scene by the mean grey value, corrected to the source's reference exposure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation

from .grey_mean import GreyMean

_ROWS = 96  # rows of the grid of examined pixels


class LightMean(GreyMean):
    """Compares the brightness of the scene, not that of the image, with the threshold.

    The source has to report the exposure of its images; without it, images count as exposed with
    the reference exposure.
    """

    quantity = "mean of grey at the reference exposure"

    def get_features(self, observation: Observation) -> NDArray[np.float64] | None:
        """Return (1,): the mean grey value at the reference exposure."""
        if observation.image_bgr is None:
            return None
        return np.array([light_mean(observation.image_bgr, observation.exposure_ratio or 1.0)])


def light_mean(image_bgr: NDArray[np.uint8], exposure_ratio: float) -> float:
    """Return the mean grey value, in [0, 255], that a BGR image (H, W, 3) has at exposure 1.

    Grey values are converted to light by the sRGB curve (IEC 61966-2-1), and light is proportional
    to the exposure. A saturated pixel counts as the least light that saturates it, and light beyond
    white at exposure 1 as white.
    """
    step = max(1, min(image_bgr.shape[:2]) // _ROWS)
    grey = cv2.cvtColor(np.ascontiguousarray(image_bgr[::step, ::step]), cv2.COLOR_BGR2GRAY)
    counts = np.bincount(grey.ravel(), minlength=256)
    values = np.arange(256) / 255.0
    light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    light = np.minimum(light / exposure_ratio, 1.0)
    greys = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return float(255.0 * (counts @ greys) / grey.size)
