"""Residuals of one pose for all measurements of its image, written out for speed.

The same residuals as in `residuals`, using that their Jacobian has many zeros.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .residuals import CHI2_DEPTH, CHI2_PIXEL, HUBER, MIN_DEPTH_M, Sightings


class PoseErrors:
    """Residuals of pixels and inverse depths in sigmas, at the pose of the last `move`."""

    def __init__(self, camera: Camera, points_local: NDArray[np.float64], seen: Sightings) -> None:
        """Set the landmarks (N, 3) [m] and their measurements."""
        self._points = points_local.T.copy()
        per_px = 1.0 / seen.sigma_px
        per_m = seen.measures_depth / seen.inverse_depth_sigma_per_m
        inverse_depth = 1.0 / np.where(seen.measures_depth, seen.depth_m, 1.0)
        u, v = seen.uv_px.T
        self._gains = np.stack([camera.fx * per_px, camera.fy * per_px, per_m])  # (3, N)
        self._goals = np.stack(
            [(u - camera.cx) * per_px, (v - camera.cy) * per_px, inverse_depth * per_m]
        )
        self._rows = np.zeros((7, *self._gains.shape))

    def move(self, T_cam_local: Transform) -> None:
        """Compute the residuals at another pose (4, 4)."""
        points_cam = T_cam_local[:3, :3] @ self._points + T_cam_local[:3, 3:]
        inverse_z = 1.0 / np.maximum(points_cam[2], MIN_DEPTH_M)
        self._view = points_cam * inverse_z  # (3, N): x / z, y / z, 1 / z
        self._view[2] = inverse_z
        self.residuals = self._gains * self._view - self._goals  # (3, N), of u, v and 1/z
        squares = self.residuals**2
        self._pixel2, self._depth2 = squares[0] + squares[1], squares[2]

    def scale(
        self, use_pixel: NDArray[np.bool_], use_depth: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return the roots of Huber's weights (3, N), zero for what is not used (N,).

        Both pixel residuals have the same weight, by their norm.
        """
        sizes = np.sqrt(np.stack([self._pixel2, self._depth2]))
        pixel, depth = np.sqrt(HUBER / np.maximum(sizes, HUBER))
        return np.stack([pixel * use_pixel, pixel * use_pixel, depth * use_depth])

    def pixels_agree(self) -> NDArray[np.bool_]:
        """Return (N,) where the pixel is within its 95 % limit."""
        return np.asarray(self._pixel2 <= CHI2_PIXEL)

    def depths_agree(self) -> NDArray[np.bool_]:
        """Return (N,) where the depth is within its 95 % limit."""
        return np.asarray(self._depth2 <= CHI2_DEPTH)

    def rows(self, scale: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Jacobian by a twist of the camera and, last, the residuals (7, 3, N), scaled.

        The next call overwrites them. A turn phi of the camera moves a point p by p x phi.
        """
        x, y, inverse_z = self._view
        by_u, by_v, by_w = self._gains * scale
        u_x, u_y, v_x, v_y = by_u * x, by_u * y, by_v * x, by_v * y
        rows, w_z = self._rows, by_w * inverse_z
        rows[0, 0], rows[1, 1] = -by_u * inverse_z, -by_v * inverse_z
        rows[2, 0], rows[2, 1], rows[2, 2] = u_x * inverse_z, v_y * inverse_z, w_z * inverse_z
        rows[3, 0], rows[3, 1], rows[3, 2] = u_x * y, by_v + v_y * y, w_z * y
        rows[4, 0], rows[4, 1], rows[4, 2] = -by_u - u_x * x, -v_x * y, -w_z * x
        rows[5, 0], rows[5, 1] = u_y, -v_x
        rows[6] = self.residuals * scale
        return rows
