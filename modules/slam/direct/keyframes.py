"""Keyframes of direct tracking: a downsampled cloud."""

from __future__ import annotations

import numpy as np

from sceneslam.types import se3
from sceneslam.types.maps import PointLayer

from ..voxel_cloud import VoxelCloud
from .view import DirectView, Tracker

_CLOUD_STEP_M, _CLOUD_TURN_RAD = 0.2, 0.2  # smallest motion between keyframes that add points
_CLOUD_STRIDE_PX = 2


class DirectKeyframes:
    """Stores the points of those keyframes that have a new view."""

    def __init__(self, tracker: Tracker, voxel_m: float) -> None:
        self._tracker = tracker
        self._cloud = VoxelCloud(voxel_m)
        self._T_local_shown: se3.Transform | None = None  # of the last keyframe that added points

    def add(self, view: DirectView, T_local_cam: se3.Transform) -> None:
        """Add the points of a keyframe that is far enough from the last one that added some."""
        if self._T_local_shown is not None:
            moved = se3.inverse(self._T_local_shown) @ T_local_cam
            is_near = np.linalg.norm(moved[:3, 3]) < _CLOUD_STEP_M
            if is_near and se3.rotation_angle_rad(moved) < _CLOUD_TURN_RAD:
                return
        self._T_local_shown = T_local_cam
        points = self._tracker.points(view, _CLOUD_STRIDE_PX)
        self._cloud.add(se3.apply(T_local_cam, points[points[:, 2] > 0]))

    def cloud(self) -> PointLayer | None:
        """Return the points (N, 3) [m], local, one per voxel; None without a keyframe."""
        if self._T_local_shown is None:
            return None
        return PointLayer(points=self._cloud.points())
