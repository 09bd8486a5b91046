"""Depth images without lens distortion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.lens import undistortion_maps
from sceneslam.types.rig import Camera


class DepthUndistortion:
    """Moves the depths of one camera's images to where a pinhole camera would show them."""

    def __init__(self, camera: Camera) -> None:
        self._maps = undistortion_maps(camera, camera) if any(camera.distortion) else None

    def apply(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a depth image (H, W) [m] without distortion; outside of the image it is 0."""
        if self._maps is None:
            return depth_m
        return np.asarray(cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST), np.float32)
