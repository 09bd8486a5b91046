"""The keyframes, and search for those that overlap with the camera's view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from ..surfaces.keyframe import SurfaceKeyframe
from ..surfaces.registration import Samples, compare
from ..surfaces.surface import Floats, Grid, Surface
from ..voxel_cloud import VoxelCloud

_PROBES = 300  # sample points for the overlap
_PROBE_GATE_M = 0.1
_NEAREST = 8  # nearest keyframes whose overlap is computed
_IMAGES_MIN = 2  # smallest number of images of a cell in the cloud


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """A keyframe's index, and the share of the sample points that it shows."""

    index: int
    ratio: float


class KeyframeMap:
    """All keyframes in order of time."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.keyframes: list[SurfaceKeyframe] = []

    def __len__(self) -> int:
        return len(self.keyframes)

    def __getitem__(self, index: int) -> SurfaceKeyframe:
        return self.keyframes[index]

    def add(self, surface: Surface, T_local_cam: se3.Transform) -> int:
        """Add a keyframe at T_local_cam (4, 4) [m]; return its index."""
        self.keyframes.append(SurfaceKeyframe(surface, T_local_cam))
        return len(self.keyframes) - 1

    def overlaps(self, samples: Samples, T_local_cam: se3.Transform) -> Sequence[Overlap]:
        """Return the overlapping keyframes, the best first."""
        probes = samples.thinned(_PROBES)
        found = []
        for index in self._nearest(probes, T_local_cam):
            keyframe = self.keyframes[index]
            T_key_cam = keyframe.T_cam_local @ T_local_cam
            same = compare(probes, keyframe, T_key_cam, _PROBE_GATE_M, self.grid)[3]
            found.append(Overlap(int(index), float(same.mean())))
        return sorted(found, key=lambda overlap: (-overlap.ratio, overlap.index))

    def alike(self, surface: Surface, count: int) -> Sequence[int]:
        """Return the `count` keyframes whose depth thumbnails are most similar to the surface's."""
        view = self._thumbnail(surface.disparity, surface.valid)
        unlike = []
        for keyframe in self.keyframes:
            known = keyframe.surface()
            other = self._thumbnail(known.disparity, known.valid)
            both = (view > 0) & (other > 0)
            far = np.abs(view - other)[both]
            unlike.append(float(far.mean()) / float(both.mean()) if len(far) else np.inf)
        order = np.argsort(unlike, kind="stable")[:count]
        return [int(index) for index in order if unlike[index] < np.inf]

    def cloud(self, voxel_m: float) -> Floats:
        """Return the surfaces' points (N, 3) [m], local, one per voxel."""
        cloud = VoxelCloud(voxel_m)
        for keyframe in self.keyframes:
            cloud.add(keyframe.points_local(self.grid, _IMAGES_MIN))
        return cloud.points()

    def _nearest(self, probes: Samples, T_local_cam: se3.Transform) -> NDArray[np.int64]:
        """Return the keyframes whose view has the nearest centre."""
        depth_m = float(np.median(probes.points[:, 2]))
        poses = np.array([keyframe.T_local_cam for keyframe in self.keyframes])
        middles = poses[:, :3, 3] + depth_m * poses[:, :3, 2]
        middle = T_local_cam[:3, 3] + depth_m * T_local_cam[:3, 2]
        return np.argsort(np.linalg.norm(middles - middle, axis=1), kind="stable")[:_NEAREST]

    def _thumbnail(self, disparity: Floats, valid: NDArray[np.bool_]) -> Floats:
        """Return the disparity in every eighth row and column, 0 where there is no surface."""
        image = np.where(valid, disparity, 0.0).reshape(self.grid.height, self.grid.width)
        return image[::8, ::8].astype(np.float32)
