"""Keyframes of direct tracking: a downsampled cloud, and a pose graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.maps import PointLayer, PoseGraphLayer

from ..voxel_cloud import VoxelCloud
from .view import DirectView, Tracker

_CLOUD_STEP_M, _CLOUD_TURN_RAD = 0.2, 0.2  # smallest motion between keyframes that add points
_CLOUD_STRIDE_PX = 2


class DirectKeyframes:
    """Stores the poses of all keyframes, and points of those with a new view."""

    def __init__(self, tracker: Tracker, voxel_m: float) -> None:
        self._tracker = tracker
        self._stamps_ns: list[int] = []
        self._T_local_cam: list[se3.Transform] = []
        self._edges: list[tuple[int, NDArray[np.float64]]] = []  # target node and information
        self._cloud = VoxelCloud(voxel_m)
        self._T_local_shown: se3.Transform | None = None  # of the last keyframe that added points

    def add(
        self,
        stamp_ns: int,
        view: DirectView,
        T_local_cam: se3.Transform,
        information: NDArray[np.float64] | None,
    ) -> None:
        """Add a keyframe; `information` (6, 6), cam, is that of the motion from the one before."""
        if information is not None:
            self._edges.append((len(self._stamps_ns), information))
        self._stamps_ns.append(stamp_ns)
        self._T_local_cam.append(T_local_cam)
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
        return PointLayer(points=self._cloud.points()) if self._stamps_ns else None

    def graph(self, T_cam_base: se3.Transform) -> PoseGraphLayer | None:
        """Return the graph of T_local_base at the keyframes; None without a keyframe."""
        if not self._stamps_ns:
            return None
        T_local_base = np.stack(self._T_local_cam) @ T_cam_base
        nodes = np.array([node for node, _ in self._edges], np.int64)
        edges = np.stack([nodes - 1, nodes], axis=1)
        back = se3.adjoint(T_cam_base)
        informations = [back.T @ information @ back for _, information in self._edges]
        T_from_to = [se3.inverse(T_local_base[a]) @ T_local_base[b] for a, b in edges.tolist()]
        return PoseGraphLayer(
            stamps_ns=np.array(self._stamps_ns, np.int64),
            T_world_base=T_local_base,
            edges=edges,
            T_from_to=np.array(T_from_to).reshape(-1, 4, 4),
            information=np.array(informations).reshape(-1, 6, 6),
            is_loop=np.zeros(len(edges), np.bool_),
        )
