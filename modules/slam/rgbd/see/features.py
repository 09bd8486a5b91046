"""Features of one image: ORB corners spread over it, undistorted, with their depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

from ..settings import RgbdSettings
from .alignment import Alignment
from .corners import CornerFinder
from .lens import undistorted

_DEPTH_REACH_PX = 2  # around a corner, in which the surface should be the same
_CROSS_PX = _DEPTH_REACH_PX * np.array([[0, -1, 1, 0, 0], [0, 0, 0, -1, 1]])  # columns, rows
_DEPTH_SPREAD_RATIO = 0.03  # a larger difference of neighbours is an edge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """The features of one image."""

    uv_px: NDArray[np.float64]  # (N, 2), without distortion
    levels: NDArray[np.int64]  # (N,), of the pyramid, ascending
    descriptors: NDArray[np.uint8]  # (N, 32)
    depth_m: NDArray[np.float64]  # (N,), along the optical axis, 0 = missing
    depth_slope_m_per_px: NDArray[np.float64]  # (N,), slope of the depth there

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def deep_count(self) -> int:
        """Return how many features have a depth."""
        return int(np.count_nonzero(self.depth_m))


class FeatureExtractor:
    """Finds features where the image holds structure above its own noise."""

    def __init__(
        self, depth_camera: Camera, alignment: Alignment, *, settings: RgbdSettings
    ) -> None:
        self._depth_camera, self._alignment = depth_camera, alignment
        self._camera = alignment.color_camera(depth_camera)
        self._corners = CornerFinder(settings)

    def extract(self, gray: NDArray[np.uint8], depth_m: NDArray[np.float32] | None) -> Features:
        """Return the features of `gray` (H, W); without a depth image all depths are missing."""
        corners = self._corners.find(gray)
        uv_px = undistorted(self._camera, corners.uv_px)
        rows = np.flatnonzero(np.isfinite(uv_px).all(axis=1))
        uv_image, uv_px = corners.uv_px.take(rows, axis=0), uv_px.take(rows, axis=0)
        depths_m, slopes = self._depths(self._in_depth(uv_image, uv_px, depth_m), depth_m)
        return Features(
            uv_px=uv_px,
            levels=corners.levels.take(rows),
            descriptors=corners.descriptors.take(rows, axis=0),
            depth_m=depths_m,
            depth_slope_m_per_px=slopes,
        )

    def _in_depth(
        self,
        uv_image: NDArray[np.float64],
        uv_px: NDArray[np.float64],
        depth_m: NDArray[np.float32] | None,
    ) -> NDArray[np.float64]:
        """Return where the depth image shows the corners."""
        if depth_m is None or self._alignment.is_registered:
            return uv_image
        images = np.zeros(len(uv_px), np.int64)
        return self._alignment.find(self._depth_camera, uv_px, depth_m[None], images)

    def _depths(
        self, uv_image: NDArray[np.float64], depth_m: NDArray[np.float32] | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the depth at each corner, and its slope [m/px].

        At depth edges, where it may be either, it is missing, as outside of the depth image.
        """
        if depth_m is None:
            return np.zeros(len(uv_image)), np.zeros(len(uv_image))
        height, width = depth_m.shape
        column, row = np.rint(uv_image).astype(np.int64).T
        columns, rows = column + _CROSS_PX[0, :, None], row + _CROSS_PX[1, :, None]
        at = np.clip(rows, 0, height - 1) * width + np.clip(columns, 0, width - 1)
        depths = np.take(depth_m, at).astype(np.float64)  # (5, N), the corner's own first
        usable = self._camera.measures(depths)
        usable[0] &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
        depth = np.where(usable[0], depths[0], 0.0)
        step = np.where(usable, np.abs(depths - depth), 0.0).max(axis=0)
        is_smooth = step <= _DEPTH_SPREAD_RATIO * depth * np.maximum(depth, 1.0)
        return np.where(is_smooth, depth, 0.0), step / _DEPTH_REACH_PX
