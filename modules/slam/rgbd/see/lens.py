"""Pixels without lens distortion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera


def undistorted(camera: Camera, uv_image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a camera without distortion would show the pixels (N, 2) of an image."""
    if not (len(uv_image) and any(camera.distortion)):
        return uv_image
    K, distortion = camera.K, np.array(camera.distortion)
    return np.asarray(cv2.undistortPoints(uv_image[:, None], K, distortion, P=K)[:, 0])
