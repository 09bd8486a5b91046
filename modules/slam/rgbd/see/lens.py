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


def undistorted_bounds(camera: Camera) -> NDArray[np.float64]:
    """Return the least and the largest pixel (2, 2) of an image without distortion.

    They are those of the sides' middles, as a lens is seldom calibrated in the corners.
    """
    width, height = camera.size_wh
    middle = (0.5 * width, 0.5 * height)
    sides = [(0.0, middle[1]), (middle[0], 0.0), (width, middle[1]), (middle[0], height)]
    left, top, right, bottom = undistorted(camera, np.array(sides, np.float64))
    return np.array([[left[0], top[1]], [right[0], bottom[1]]])
