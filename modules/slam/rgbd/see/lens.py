"""Pixels without lens distortion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.lens import undistorted_rays
from sceneslam.types.rig import Camera

_STEPS = 65  # pixels along a line through the image's centre


def undistorted(camera: Camera, uv_image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a camera without distortion would show the pixels (N, 2) of an image.

    NaN for pixels without a ray, see `undistorted_rays`.
    """
    if not any(camera.distortion):
        return uv_image
    rays = undistorted_rays(camera, uv_image)
    return rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def undistorted_bounds(camera: Camera) -> NDArray[np.float64]:
    """Return the least and the largest pixel (2, 2) that an image may show without distortion.

    They are those of its middle row and column, as a lens is seldom calibrated in the corners, or
    those of the distorted image: by narrower bounds freiburg1_rpy, every second image, lost one of
    200.
    """
    size = np.array(camera.size_wh, np.float64)
    along, middle = np.linspace(0.0, 1.0, _STEPS)[:, None] * size, np.tile(size / 2, (_STEPS, 1))
    row = undistorted(camera, np.column_stack([along[:, 0], middle[:, 1]]))
    column = undistorted(camera, np.column_stack([middle[:, 0], along[:, 1]]))
    shown = np.column_stack([row[:, 0], column[:, 1]])
    least, most = np.fmin.reduce(shown), np.fmax.reduce(shown)
    return np.stack([np.fmin(least, 0.0), np.fmax(most, size)])
