"""Limit the memory of closed sessions' maps, so that a run of hours in one place needs no more."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.fusion import one_per_voxel
from sceneslam.atlas.pose_path import OpenSession
from sceneslam.executors import InStep, executor
from sceneslam.types import se3
from sceneslam.types.maps import LandmarkLayer, MapLayers, PointLayer, ScanLayer

_REST = 0.5  # share of the limit that is left by thinning, so that it is not due at every session

Layer = PointLayer | LandmarkLayer


class Budget:
    """Thins clouds and landmarks to one per module and voxel once they need more than `limit_mb`.

    Where that is not enough, as in a large building, the voxels grow. Of scans that need more than
    half of what is left, every second one goes. Sessions lie where they were placed during the run;
    their points stay in their own frames, so that later corrections apply.
    """

    def __init__(self, *, limit_mb: float, voxel_m: float) -> None:
        self._limit, self._voxel_m = limit_mb * 1e6, voxel_m  # bytes
        self._executor: Executor = InStep()
        self._thinning: Future[None] | None = None

    def open(self, *, is_live: bool) -> None:
        """Begin; a live run thins in another thread."""
        self._executor = executor("budget", is_live=is_live)

    def keep(self, sessions: Sequence[OpenSession]) -> None:
        """Thin the sessions' layers if they need too much in all."""
        if sum(_bytes(session.layers) for session in sessions) <= self._limit:
            return
        if self._thinning is None or self._thinning.done():
            rest = _REST * self._limit
            self._thinning = self._executor.submit(thin, tuple(sessions), self._voxel_m, rest)

    def close(self) -> None:
        """Wait until the layers are thinned; raises what that raised."""
        self._executor.shutdown()
        if self._thinning is not None:
            self._thinning.result()


def thin(sessions: Sequence[OpenSession], voxel_m: float, most: float) -> None:
    """Leave one point per module and voxel, the first; double the voxel down to `most` bytes.

    At the least a few points per module are left.
    """
    _thin_scans(sessions, 0.5 * most)
    layers = [session.layers for session in sessions]  # a session that is closed meanwhile is kept
    modules = list(dict.fromkeys(session.module for session in sessions))
    owners = [modules.index(session.module) for session in sessions]
    poses = [session.T_map_local for session in sessions]
    clouds = [cloud for one in layers for cloud in (one.points, one.landmarks) if cloud is not None]
    reach_m = max((float(np.abs(cloud.points).max(initial=0.0)) for cloud in clouds), default=0.0)
    reach_m += max(float(np.linalg.norm(T[:3, 3])) for T in poses)
    while True:
        points = _kept([one.points for one in layers], owners, poses, voxel_m)
        landmarks = _kept([one.landmarks for one in layers], owners, poses, voxel_m)
        left = [_of(*one) for one in zip(layers, points, landmarks, strict=True)]
        if sum(map(_bytes, left)) <= most or voxel_m > 2.0 * reach_m:
            break
        voxel_m *= 2.0
    for session, before, after in zip(sessions, layers, left, strict=True):
        if before.points is not None or before.landmarks is not None:
            session.layers = replace(session.layers, points=after.points, landmarks=after.landmarks)


def _thin_scans(sessions: Sequence[OpenSession], most: float) -> None:
    """Leave every second scan of all sessions, down to `most` bytes or one scan each."""
    while True:
        held = [one.layers.scans for one in sessions if one.layers.scans is not None]
        too_many = sum(_bytes_of(one) for one in held) > most
        if not too_many or max(len(one.stamps_ns) for one in held) < 2:
            return
        for session in sessions:
            scans = session.layers.scans
            if scans is not None:
                rows = np.arange(0, len(scans.stamps_ns), 2)  # copied: a slice keeps the others
                session.layers = replace(session.layers, scans=_taken(scans, rows))


def _taken(layer: Any, rows: NDArray[np.intp]) -> Any:
    """Return a layer with these rows of its arrays."""
    arrays = {each.name: getattr(layer, each.name) for each in fields(layer)}
    taken = {name: of[rows] for name, of in arrays.items() if isinstance(of, np.ndarray)}
    return replace(layer, **taken)


def _of(layers: MapLayers, rows: NDArray[np.intp], marks: NDArray[np.intp]) -> MapLayers:
    """Return layers with these rows of their points and landmarks."""
    points, landmarks = layers.points, layers.landmarks
    points = None if points is None else _taken(points, rows)
    landmarks = None if landmarks is None else _taken(landmarks, marks)
    return replace(layers, points=points, landmarks=landmarks)


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


def _bytes(layers: MapLayers) -> int:
    """Return what points, landmarks and scans need."""
    held = (layers.points, layers.landmarks, layers.scans)
    return sum(_bytes_of(one) for one in held if one is not None)


def _bytes_of(layer: Layer | ScanLayer) -> int:
    arrays = [getattr(layer, each.name) for each in fields(layer)]
    return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))
