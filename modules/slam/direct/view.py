"""Downscaled and undistorted images with depth, and their registration by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.lens import undistortion_maps
from sceneslam.types.rig import Camera

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DirectView:
    """One image with its depth."""

    grey: NDArray[np.uint8]  # (h, w)
    depth_m: Floats  # (h, w), 0 = missing
    frame: Any  # prepared by OpenCV

    def shows_same(self, before: DirectView) -> bool:
        """Tell whether the image is the one before, to the last bit, beside another depth.

        One that is black or white all over may come again.
        """
        is_same = np.array_equal(self.grey, before.grey)
        if not is_same or np.array_equal(self.depth_m, before.depth_m):
            return False
        return bool(np.ptp(np.percentile(self.grey, [25, 75])) > 0)


class Tracker:
    """OpenCV's RGB-D odometry (Steinbruecker et al., 2011) on views of one camera."""

    def __init__(self, camera: Camera, width_px: int, step_max_m: float, turn_max_rad: float):
        full = np.array(camera.size_wh)
        scale = min(width_px / full[0], 1.0)
        self._size_wh = (round(full[0] * scale), round(full[1] * scale))
        resized = np.diag([scale, scale, 1.0])
        resized[:2, 2] = 0.5 * scale - 0.5  # pixel centres are at whole numbers
        self.K = resized @ camera.K
        (fx, _, cx), (_, fy, cy) = self.K[:2].tolist()
        small = replace(camera, size_wh=self._size_wh, fx=fx, fy=fy, cx=cx, cy=cy)
        self._maps_grey = undistortion_maps(small, small)
        self._maps_depth = undistortion_maps(camera, small)
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(self.K.astype(np.float32))
        near_m, far_m = camera.depth_range_m
        settings.setMinDepth(near_m)
        settings.setMaxDepth(far_m)
        settings.setMaxTranslation(step_max_m)
        settings.setMaxRotation(float(np.rad2deg(turn_max_rad)))
        kind, method = cv2.OdometryType_RGB_DEPTH, cv2.OdometryAlgoType_COMMON
        self._odometry = cv2.Odometry(kind, settings, method)
        self._camera = camera

    def view(self, image_bgr: NDArray[np.uint8], depth_m: Floats) -> DirectView:
        """Return the view of an image (H, W, 3) and its depth (H, W) [m]."""
        grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
        grey = cv2.resize(grey, self._size_wh, interpolation=cv2.INTER_AREA)
        grey = cv2.remap(grey, *self._maps_grey, cv2.INTER_LINEAR)
        measured = np.where(self._camera.measures(depth_m), depth_m, np.float32(0))
        small_m = cv2.remap(measured, *self._maps_depth, cv2.INTER_NEAREST)
        frame = cv2.OdometryFrame(small_m, grey)
        self._odometry.prepareFrame(frame)
        return DirectView(
            grey=np.asarray(grey, np.uint8), depth_m=np.asarray(small_m, np.float32), frame=frame
        )

    def points(self, view: DirectView, stride_px: int) -> Floats:
        """Return every stride-th pixel's point (N, 3) [m], cam; z is 0 where depth is missing."""
        z = view.depth_m[::stride_px, ::stride_px]
        v, u = np.mgrid[: z.shape[0], : z.shape[1]] * stride_px
        x, y = (u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1]
        return np.stack([x * z, y * z, z], axis=-1).reshape(-1, 3).astype(np.float32)

    def register(self, view: DirectView, other: DirectView) -> se3.Transform | None:
        """Return T_other_view (4, 4) [m], None if the registration fails."""
        found, T_other_view = self._odometry.compute(view.frame, other.frame)
        if not found or not np.isfinite(T_other_view).all():
            return None
        return se3.orthonormal(np.asarray(T_other_view, np.float64))
