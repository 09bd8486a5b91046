"""Reprojection residuals of landmarks: pixels and inverse depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

CHI2_PIXEL = 5.99  # 95 % of two degrees of freedom
CHI2_DEPTH = 3.84  # 95 % of one
HUBER = 2.0  # [sigma]
MIN_DEPTH_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Measured pixels and depths of landmarks, with standard deviations."""

    uv_px: NDArray[np.float64]  # (N, 2), without distortion
    sigma_px: NDArray[np.float64]  # (N,)
    depth_m: NDArray[np.float64]  # (N,), 0 = missing
    inverse_depth_sigma_per_m: NDArray[np.float64]  # (N,)

    @property
    def measures_depth(self) -> NDArray[np.bool_]:
        """Return (N,) True where depth is measured."""
        return np.asarray(self.depth_m > 0)

    def take(self, rows: NDArray[np.int64]) -> Sightings:
        """Return the rows (M,) alone."""
        return Sightings(
            uv_px=self.uv_px.take(rows, axis=0),
            sigma_px=self.sigma_px.take(rows),
            depth_m=self.depth_m.take(rows),
            inverse_depth_sigma_per_m=self.inverse_depth_sigma_per_m.take(rows),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Errors:
    """Residuals in sigmas, as in stereo bundle adjustment (Mur-Artal and Tardos 2017).

    A depth camera's disparity error is constant, so its depth error grows with the square.
    """

    points_cam: NDArray[np.float64]  # (3, N) [m]
    of: NDArray[np.float64]  # (3, N), of u, v and 1/z
    by_point: NDArray[np.float64]  # (3, 3, N): residual, component of the point in cam

    def by_twist(self) -> NDArray[np.float64]:
        """Return the Jacobian (6, 3, N) by a twist of the camera."""
        slopes = np.empty((6, *self.of.shape))
        slopes[:3] = -np.swapaxes(self.by_point, 0, 1)
        p, move = self.points_cam, slopes[:3]
        # A turn phi of the camera moves the point by points_cam x phi.
        slopes[3] = p[1] * move[2] - p[2] * move[1]
        slopes[4] = p[2] * move[0] - p[0] * move[2]
        slopes[5] = p[0] * move[1] - p[1] * move[0]
        return slopes

    def huber_weights(self) -> NDArray[np.float64]:
        """Return weights (3, N); u and v have the same weight, by their norm."""
        pixel = np.sqrt(self.of[0] ** 2 + self.of[1] ** 2)
        sizes = np.stack([pixel, pixel, np.abs(self.of[2])])
        return np.asarray(HUBER / np.maximum(sizes, HUBER))

    def pixels_agree(self) -> NDArray[np.bool_]:
        """Return (N,) where the pixel is within its 95 % limit."""
        return np.asarray((self.of[:2] ** 2).sum(axis=0) <= CHI2_PIXEL)

    def depths_agree(self) -> NDArray[np.bool_]:
        """Return (N,) where the depth is within its 95 % limit."""
        return np.asarray(self.of[2] ** 2 <= CHI2_DEPTH)


def errors(camera: Camera, points_cam: NDArray[np.float64], seen: Sightings) -> Errors:
    """Return the residuals of landmarks (3, N) [m] in the camera, with Jacobians."""
    inverse_z = 1.0 / np.maximum(points_cam[2], MIN_DEPTH_M)
    x, y = points_cam[0] * inverse_z, points_cam[1] * inverse_z
    per_px = 1.0 / seen.sigma_px
    per_m = seen.measures_depth / seen.inverse_depth_sigma_per_m
    depth_m = np.where(seen.measures_depth, seen.depth_m, 1.0)
    of = np.stack(
        [
            (camera.fx * x + camera.cx - seen.uv_px[:, 0]) * per_px,
            (camera.fy * y + camera.cy - seen.uv_px[:, 1]) * per_px,
            (inverse_z - 1.0 / depth_m) * per_m,
        ]
    )
    by_point = np.zeros((3, 3, len(x)))
    by_point[0, 0] = du = camera.fx * per_px * inverse_z
    by_point[1, 1] = dv = camera.fy * per_px * inverse_z
    by_point[0, 2], by_point[1, 2] = -du * x, -dv * y
    by_point[2, 2] = -(inverse_z**2) * per_m
    return Errors(points_cam=points_cam, of=of, by_point=by_point)
