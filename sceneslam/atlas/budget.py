"""Limit the points that closed sessions keep, so that a run of hours in one place needs no more."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.fusion import one_per_voxel
from sceneslam.atlas.pose_path import OpenSession
from sceneslam.executors import InStep, executor
from sceneslam.types import se3
from sceneslam.types.maps import LandmarkLayer, PointLayer

_REST = 0.5  # share of the limit that is left by thinning, so that it is not due at every session

Layer = PointLayer | LandmarkLayer


class Budget:
    """Thins clouds and landmarks to one per module and voxel once there are more than `limit`.

    Where that is not enough, as in a large building, the voxels grow. Sessions lie where they were
    placed during the run; their points stay in their own frames, so that later corrections apply.
    """

    def __init__(self, *, limit: int, voxel_m: float) -> None:
        self._limit, self._voxel_m = limit, voxel_m
        self._executor: Executor = InStep()
        self._thinning: Future[None] | None = None

    def open(self, *, is_live: bool) -> None:
        """Begin; a live run thins in another thread."""
        self._executor = executor("budget", is_live=is_live)

    def keep(self, sessions: Sequence[OpenSession]) -> None:
        """Thin the sessions' layers if there are too many points in all."""
        if sum(_count(session) for session in sessions) <= self._limit:
            return
        if self._thinning is None or self._thinning.done():
            rest = round(_REST * self._limit)
            self._thinning = self._executor.submit(thin, tuple(sessions), self._voxel_m, rest)

    def close(self) -> None:
        """Wait until the layers are thinned; raises what that raised."""
        self._executor.shutdown()
        if self._thinning is not None:
            self._thinning.result()


def thin(sessions: Sequence[OpenSession], voxel_m: float, most: int) -> None:
    """Leave one point per module and voxel, the first; double the voxel until `most` are left."""
    layers = [session.layers for session in sessions]  # a session that is closed meanwhile is kept
    modules = list(dict.fromkeys(session.module for session in sessions))
    owners = [modules.index(session.module) for session in sessions]
    poses = [session.T_map_local for session in sessions]
    while True:
        points = _kept([one.points for one in layers], owners, poses, voxel_m)
        landmarks = _kept([one.landmarks for one in layers], owners, poses, voxel_m)
        if sum(len(rows) for rows in (*points, *landmarks)) <= most:
            break
        voxel_m *= 2.0
    for session, before, rows, marks in zip(sessions, layers, points, landmarks, strict=True):
        if before.points is not None:
            colors = before.points.colors_bgr
            cloud = PointLayer(
                points=before.points.points[rows],
                colors_bgr=None if colors is None else colors[rows],
            )
            session.layers = replace(session.layers, points=cloud)
        if before.landmarks is not None:
            seen = before.landmarks
            layer = LandmarkLayer(
                points=seen.points[marks],
                first_stamps_ns=seen.first_stamps_ns[marks],
                sightings=seen.sightings[marks],
            )
            session.layers = replace(session.layers, landmarks=layer)


def _kept(
    layers: Sequence[Layer | None],
    owners: Sequence[int],
    poses: Sequence[se3.Transform],
    voxel_m: float,
) -> list[NDArray[np.intp]]:
    """Return per session the rows of the points that are kept."""
    clouds = [np.zeros((0, 3), np.float32) if one is None else one.points for one in layers]
    counts = [len(cloud) for cloud in clouds]
    placed = [se3.apply(T, cloud) for T, cloud in zip(poses, clouds, strict=True)]
    owner = np.repeat(np.array(owners, np.uint8), counts)
    kept = one_per_voxel(np.concatenate(placed).astype(np.float32), owner, voxel_m)
    ends = np.cumsum(counts)
    parts = np.split(kept, np.searchsorted(kept, ends[:-1]))
    return [rows - (end - count) for rows, end, count in zip(parts, ends, counts, strict=True)]


def _count(session: OpenSession) -> int:
    layers = session.layers
    held = [one for one in (layers.points, layers.landmarks) if one is not None]
    return sum(len(one.points) for one in held)
