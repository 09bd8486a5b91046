"""Rays of a camera's pixels, and its images, without lens distortion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

Floats = NDArray[np.float32]

_SAME_PX = 1.0  # a ray's own pixel is nearer than this
# Iterations, and the error [px] after which they end: OpenCV's 5 lose the corners of wide lenses.
_ENOUGH = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-3)


def undistorted_rays(camera: Camera, uv_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rays (N, 2), x / z and y / z in cam, of the pixels (N, 2) of an image.

    A ray is NaN where the distortion does not show it at its pixel again: OpenCV's iteration does
    not converge where a lens model folds or bends too much, and does not say so.
    """
    if not len(uv_px):
        return np.zeros((0, 2))
    distortion = np.array(camera.distortion)
    found = cv2.undistortPoints(uv_px[:, None], camera.K, distortion, criteria=_ENOUGH)
    rays = np.asarray(found[:, 0], np.float64)
    if distortion.any():
        points_cam, still = np.column_stack([rays, np.ones(len(rays))]), np.zeros(3)
        again_px = cv2.projectPoints(points_cam, still, still, camera.K, distortion)[0][:, 0]
        off_px = np.linalg.norm(again_px - uv_px, axis=1)
        rays[~(off_px < _SAME_PX)] = np.nan
    return rays


def undistortion_maps(camera: Camera, pinhole: Camera) -> tuple[Floats, Floats]:
    """Return the columns and rows (H, W) [px] where a camera's image shows the pixels of another's.

    The other has the same frame, and no distortion. The maps are for `cv2.remap`. Pixels whose ray
    the image does not show are at -1: beyond where a lens model folds, it shows another ray.
    """
    distortion = np.array(camera.distortion)
    columns, rows = cv2.initUndistortRectifyMap(
        camera.K, distortion, np.eye(3), pinhole.K, pinhole.size_wh, cv2.CV_32FC1
    )
    if distortion.any():
        v_px, u_px = np.indices(columns.shape).reshape(2, -1)
        shown_px = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        x, y = undistorted_rays(camera, shown_px).T
        off_u_px, off_v_px = x * pinhole.fx + pinhole.cx - u_px, y * pinhole.fy + pinhole.cy - v_px
        is_same = (np.hypot(off_u_px, off_v_px) < _SAME_PX).reshape(columns.shape)
        columns, rows = np.where(is_same, columns, -1.0), np.where(is_same, rows, -1.0)
    return np.asarray(columns, np.float32), np.asarray(rows, np.float32)
