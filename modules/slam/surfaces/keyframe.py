"""A keyframe: a grid of planes, averaged over later images that show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from .surface import Floats, Grid, Surface

FACING_COS = 0.7  # normals that differ by more than 45 degrees belong to different surfaces
_FUSE_SIGMAS = 4.0
_COUNT_MAX = 50.0  # largest number of images in a plane's mean


class SurfaceKeyframe:
    """A surface at a pose in `local`, which the pose graph may move."""

    def __init__(self, surface: Surface, T_local_cam: se3.Transform) -> None:
        self.planes = surface.planes.copy()  # (N, 4), cam: see Surface
        self.noise_per_m = surface.noise_per_m
        self._disparity = surface.disparity.copy()
        self._count = surface.valid.astype(np.float32)
        self.move(T_local_cam)

    def move(self, T_local_cam: se3.Transform) -> None:
        """Set T_local_cam and its exact inverse.

        Rounding errors would grow along the chain of keyframes.
        """
        self.T_local_cam = se3.orthonormal(T_local_cam)
        self.T_cam_local = se3.inverse(self.T_local_cam)

    def fuse(self, surface: Surface, T_local_cam: se3.Transform, grid: Grid) -> None:
        """Fuse another surface at T_local_cam (4, 4) [m] into this keyframe, per cell.

        Each cell's ray is intersected with the other surface's plane there, so that both measure
        the same quantity: the disparity along this ray.
        """
        rows = np.flatnonzero(self._count)
        T_other_cam = (se3.inverse(T_local_cam) @ self.T_local_cam).astype(np.float32)
        points = grid.rays[rows] / self._disparity[rows, None]
        turned = np.asarray(points @ T_other_cam[:3, :3].T, np.float32)
        cells, seen = grid.index(np.asarray(turned + T_other_cam[:3, 3], np.float32))
        planes = surface.planes[cells]
        along = np.einsum("ij,ij->i", planes[:, :3], turned)
        stretch = (planes[:, 3] - planes[:, :3] @ T_other_cam[:3, 3]) / np.where(
            along > 1e-3, along, 1.0
        )
        change = (1.0 / np.maximum(stretch, 0.1) - 1.0) * self._disparity[rows]
        normals = planes[:, :3] @ T_other_cam[:3, :3]
        facing = np.einsum("ij,ij->i", normals, self.planes[rows, :3])
        same = seen & (facing > FACING_COS) & (np.abs(change) < _FUSE_SIGMAS * self.noise_per_m)
        self._average(rows[same], change[same], normals[same], grid)

    def surface(self) -> Surface:
        """Return the current planes."""
        return Surface(self._disparity, self.planes, self._count > 0, self.noise_per_m)

    def points_local(self, grid: Grid, images_min: int) -> Floats:
        """Return the points (N, 3) [m], local, of cells with at least `images_min` images."""
        rows = np.flatnonzero(self._count >= images_min)
        points_cam = grid.rays[rows] / self._disparity[rows, None]
        return np.asarray(se3.apply(self.T_local_cam, points_cam))

    def _average(
        self, rows: NDArray[np.int64], change: Floats, normals: Floats, grid: Grid
    ) -> None:
        count = self._count[rows]
        disparity = self._disparity[rows] + change / (count + 1.0)
        mean = self.planes[rows, :3] * count[:, None] + normals
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        self._disparity[rows] = disparity
        self._count[rows] = np.minimum(count + 1.0, _COUNT_MAX)
        self.planes[rows, :3] = mean
        self.planes[rows, 3] = np.einsum("ij,ij->i", mean, grid.rays[rows]) / disparity
