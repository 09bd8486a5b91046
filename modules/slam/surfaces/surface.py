"""Conversion of a depth image to a grid of small planes, with an estimate of its noise.

The noise of triangulating depth cameras is uniform in disparity 1/z, in which planes are linear:
pixels are averaged per cell in disparity, and a plane is fitted to each cell and its neighbours.
Cells without a plane (edges, flying pixels, depth that is too far) are invalid. The residuals of
the fits give the sensor's noise, so that no range limit or sensor model is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

from .undistortion import DepthUndistortion

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_NEAR_M = 0.05  # smallest depth
_COLUMNS = 160  # columns of the grid; finer grids cost more without better poses
_SMOOTH = (5, 5)  # cells
_OUTLIER_SIGMAS = 3.0
_GRAZING_COS = 0.17  # between ray and normal: 80 degrees
_NOISE_MIN_PER_M = 2e-4  # of disparity [1/m]: 0.2 mm at 1 m


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A pinhole camera with few pixels and without distortion, with the camera's field of view."""

    width: int
    height: int
    fx: float  # [px of the grid]
    fy: float
    cx: float
    cy: float
    rays: Floats  # (height * width, 3) with z = 1, cam

    def index(self, points_cam: Floats) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """Return the cell (N,) of points (N, 3) [m], cam, and whether it is in view (N,)."""
        z = points_cam[:, 2]
        scale = 1.0 / np.maximum(z, np.float32(_NEAR_M))
        # Checked before the cast, which would round -0.5 to cell 0.
        u = points_cam[:, 0] * scale * np.float32(self.fx) + np.float32(self.cx + 0.5)
        v = points_cam[:, 1] * scale * np.float32(self.fy) + np.float32(self.cy + 0.5)
        seen = (z > _NEAR_M) & (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        cells = v.astype(np.int32) * np.int32(self.width) + u.astype(np.int32)
        return np.where(seen, cells, 0), seen


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The planes of one depth image, per cell of the grid."""

    disparity: Floats  # (N,) [1/m], of the plane at the cell's ray
    planes: Floats  # (N, 4) normal (away from the camera) and offset [m]: n @ X = d; else 0
    valid: NDArray[np.bool_]  # (N,)
    noise_per_m: float  # standard deviation of a cell's disparity [1/m]

    def smooth_normals(self, grid: Grid) -> Floats:
        """Return normals (N, 3), cam, averaged over neighbours to reduce noise."""
        image = self.planes[:, :3].reshape(grid.height, grid.width, 3)
        total = np.asarray(cv2.blur(image, _SMOOTH, borderType=cv2.BORDER_CONSTANT)).reshape(-1, 3)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.asarray(total / np.maximum(length, 1e-6), np.float32)


class DepthSurfaceReader:
    """Converts one camera's depth images to surfaces."""

    def __init__(self, camera: Camera) -> None:
        """Choose the grid, and compute a table from its pixels to the camera's."""
        width, height = camera.size_wh
        self._factor = max(1, round(width / _COLUMNS))
        columns, rows = width // self._factor, height // self._factor
        fx, fy = camera.fx / self._factor, camera.fy / self._factor
        cx = (camera.cx + 0.5) / self._factor - 0.5
        cy = (camera.cy + 0.5) / self._factor - 0.5
        v, u = np.mgrid[:rows, :columns]
        x, y = (u - cx) / fx, (v - cy) / fy
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
        self.grid = Grid(columns, rows, fx, fy, cx, cy, rays)
        self._reach = np.linalg.norm(rays, axis=1)
        near_m, far_m = camera.depth_range_m
        self._range_m = (max(near_m, _NEAR_M), far_m)  # 0 is missing in any case
        self._crop = (slice(rows * self._factor), slice(columns * self._factor))
        self._undistortion = DepthUndistortion(camera)

    def read(self, depth_m: Floats) -> Surface:
        """Return the surface of a depth image (H, W) [m]; cells of 0 or NaN are invalid."""
        disparity, seen = self._cells(depth_m)
        fit = _PlaneFit(disparity.astype(np.float64), seen.astype(np.float64))
        w, slope_x, slope_y = fit.value, fit.slope_u * self.grid.fx, fit.slope_v * self.grid.fy
        rays = self.grid.rays
        normals = np.stack([slope_x, slope_y, w - slope_x * rays[:, 0] - slope_y * rays[:, 1]], -1)
        length = np.linalg.norm(normals, axis=1)
        noise = fit.noise()
        valid = fit.held & (fit.scatter < _OUTLIER_SIGMAS * noise) & (w > 0)
        valid &= np.abs(disparity.ravel() - w) < _OUTLIER_SIGMAS * noise
        valid &= w > _GRAZING_COS * length * self._reach
        planes = np.zeros((len(w), 4), np.float32)
        planes[valid, :3] = normals[valid] / length[valid, None]
        planes[valid, 3] = 1.0 / length[valid]
        return Surface(w.astype(np.float32), planes, valid, noise)

    def _cells(self, depth_m: Floats) -> tuple[Floats, Floats]:
        """Return the mean disparity per cell, and 1 where at least half of the cell has depth."""
        depth_m = self._undistortion.apply(depth_m)[self._crop]
        with np.errstate(invalid="ignore"):
            known = (depth_m >= self._range_m[0]) & (depth_m <= self._range_m[1])
        disparity = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=known)
        size = (self.grid.width, self.grid.height)
        share = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mean = cv2.resize(disparity, size, interpolation=cv2.INTER_AREA)
        seen = (share >= 0.5).astype(np.float32)
        return np.asarray(mean / np.maximum(share, 0.5) * seen), seen


class _PlaneFit:
    """Least squares of w(u, v) over each cell and its neighbours, by box filters.

    It uses float64, since the residual is a small difference of large sums.
    """

    def __init__(self, w: Doubles, seen: Doubles) -> None:
        """Fit; `w` (rows, columns) is 0 where `seen` is 0."""
        one, step, square = np.ones(3), np.array([-1.0, 0.0, 1.0]), np.array([1.0, 0.0, 1.0])

        def total(image: Doubles, along_u: Doubles, along_v: Doubles) -> Doubles:
            filtered = cv2.sepFilter2D(image, -1, along_u, along_v, borderType=cv2.BORDER_CONSTANT)
            return np.asarray(filtered, np.float64).ravel()

        count = total(seen, one, one)
        n = np.maximum(count, 1.0)
        u, v, mean = total(seen, step, one) / n, total(seen, one, step) / n, total(w, one, one) / n
        uu = total(seen, square, one) - n * u * u
        vv = total(seen, one, square) - n * v * v
        uv = total(seen, step, step) - n * u * v
        wu, wv = total(w, step, one) - n * u * mean, total(w, one, step) - n * v * mean
        ww = total(w * w, one, one) - n * mean * mean
        determinant = uu * vv - uv * uv
        self.held = (count >= 6) & (determinant > 1.0) & (seen.ravel() > 0)
        inverse = 1.0 / np.where(self.held, determinant, 1.0)
        self.slope_u, self.slope_v = (vv * wu - uv * wv) * inverse, (uu * wv - uv * wu) * inverse
        self.value = mean - self.slope_u * u - self.slope_v * v
        rest = np.maximum(ww - self.slope_u * wu - self.slope_v * wv, 0.0)
        self.scatter = np.sqrt(rest / np.maximum(count - 3.0, 1.0))  # [1/m], per cell

    def noise(self) -> float:
        """Return the median residual of this image."""
        scatter = self.scatter[self.held]
        return (
            max(float(np.median(scatter)), _NOISE_MIN_PER_M) if len(scatter) else _NOISE_MIN_PER_M
        )
