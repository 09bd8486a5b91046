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
    """Return the least and the largest pixel (2, 2) that an image may show without distortion.

    They are those of its sides' middles, as a lens is seldom calibrated in the corners, or those of
    the distorted image: by narrower bounds freiburg1_rpy, every second image, lost one of 200.
    """
    size = width, height = np.array(camera.size_wh, np.float64)
    sides = [(0.0, height / 2), (width / 2, 0.0), (width, height / 2), (width / 2, height)]
    left, top, right, bottom = undistorted(camera, np.array(sides))
    shown = np.array([[left[0], top[1]], [right[0], bottom[1]]])
    return np.stack([np.minimum(shown[0], 0.0), np.maximum(shown[1], size)])
