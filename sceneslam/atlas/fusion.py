"""Fuses the maps of all sessions into one: points side by side, grids summed as log odds."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.occupancy_grid import drawn, walls
from sceneslam.types import se3
from sceneslam.types.grid_frames import grid_corners, resampled
from sceneslam.types.maps import (
    GridLayer,
    HybridMap,
    LandmarkLayer,
    MapLayers,
    PointLayer,
    PoseGraphLayer,
)
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)
_GREY = 160  # colour of points that no camera saw
_CELLS_MAX = 10**8  # 500 m x 500 m at 5 cm: 400 MB during the fusion
_LOG_ODDS_LIMIT = 10.0  # limited, so that a cell can still change after many sessions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placed:
    """The map of a session."""

    module: str
    T_map_local: Transform
    layers: MapLayers  # in `local`
    T_map_laser: NDArray[np.float64] | None = None  # (K, 4, 4) of its scans, if it has any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _PlacedGrid:
    """A grid of a session."""

    module: str
    T_map_local: Transform
    layer: GridLayer
    corners: NDArray[np.float64]  # (4, 2) [m], map


def fuse(
    placed: Sequence[Placed], *, voxel_m: float, pose_graph: PoseGraphLayer | None = None
) -> HybridMap:
    """Return one map of all layers; points are thinned to one per module and voxel.

    A session without points has those of its scans. A grid is left out if the map would need too
    much memory with it.
    """
    modules = tuple(dict.fromkeys(one.module for one in placed))
    points, colors, owners = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)], []
    for one in placed:
        layer = _points(one)
        if layer is None or not len(layer.points):
            continue
        points.append(layer.points)
        grey = np.full((len(layer.points), 3), _GREY, np.uint8)
        colors.append(grey if layer.colors_bgr is None else layer.colors_bgr.astype(np.uint8))
        owners.append(np.full(len(layer.points), modules.index(one.module), np.uint8))
    cloud, color = np.concatenate(points), np.concatenate(colors)
    owner = np.concatenate([np.zeros(0, np.uint8), *owners])
    keep = one_per_voxel(cloud, owner, voxel_m)
    landmarks, landmark_modules = _join_landmarks(placed, modules)
    return HybridMap(
        points=PointLayer(points=cloud[keep], colors_bgr=color[keep]),
        point_modules=owner[keep],
        modules=modules,
        grid=_fuse_grids(_fitting([grid for one in placed for grid in _grids(one)], voxel_m)),
        pose_graph=pose_graph,
        landmarks=landmarks,
        landmark_modules=landmark_modules,
    )


def _points(one: Placed) -> PointLayer | None:
    """Return a session's points in `map`."""
    layer, scans = one.layers.points, one.layers.scans
    if layer is not None:
        points = se3.apply(one.T_map_local, layer.points).astype(np.float32)
        return PointLayer(points=points, colors_bgr=layer.colors_bgr)
    if scans is None or one.T_map_laser is None:
        return None
    return PointLayer(points=walls(scans, one.T_map_laser))


def _grids(one: Placed) -> list[_PlacedGrid]:
    """Return a session's grids with their poses."""
    grid, scans, found = one.layers.grid, one.layers.scans, []
    if grid is not None:
        found.append((one.T_map_local, grid))
    if scans is not None and one.T_map_laser is not None:
        found.append((se3.identity(), drawn(scans, one.T_map_laser)))
    return [
        _PlacedGrid(module=one.module, T_map_local=T, layer=grid, corners=grid_corners(T, grid))
        for T, grid in found
        if grid.log_odds.size
    ]


def _join_landmarks(
    placed: Sequence[Placed], modules: tuple[str, ...]
) -> tuple[LandmarkLayer | None, NDArray[np.uint8] | None]:
    """Return all sessions' landmarks (N, 3) [m], map, and the module index of each.

    Shared landmarks occur once per session.
    """
    seen = [(one, layer) for one in placed if (layer := one.layers.landmarks) is not None]
    if not seen:
        return None, None
    points = [se3.apply(one.T_map_local, layer.points).astype(np.float32) for one, layer in seen]
    landmarks = LandmarkLayer(
        points=np.concatenate(points),
        first_stamps_ns=np.concatenate([layer.first_stamps_ns for _, layer in seen]),
        sightings=np.concatenate([layer.sightings for _, layer in seen]).astype(np.int64),
    )
    numbers = [np.uint8(modules.index(one.module)) for one, _ in seen]
    return landmarks, np.repeat(numbers, [len(layer.points) for _, layer in seen])


def one_per_voxel(
    points: NDArray[np.float32], owner: NDArray[np.uint8], voxel_m: float
) -> NDArray[np.intp]:
    """Return the indices (M,) of the first of points (N, 3) [m] per voxel and owner (N,)."""
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    spans = cells.max(axis=0, initial=0) + 1
    keys = ((cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]) * 256 + owner
    _, first = np.unique(keys, return_index=True)
    return np.sort(first)


@np.errstate(over="ignore", invalid="ignore")  # where cells have no sensible size
def _fitting(placed: Sequence[_PlacedGrid], voxel_m: float) -> list[_PlacedGrid]:
    """Return the grids that fit into one; those with cells of about `voxel_m` are taken first."""
    kept: list[_PlacedGrid] = []
    for one in sorted(placed, key=lambda one: _rank(one, voxel_m)):
        low, end = _bounds([*kept, one])
        columns, rows = (end - low).tolist()
        if 0 < columns * rows <= _CELLS_MAX:
            kept.append(one)
        else:
            why = f"with it the map would have {columns:.4g} x {rows:.4g} cells"
            _log.warning("the grid of %s is left out: %s", one.module, why)
    return [one for one in placed if one in kept]


def _rank(one: _PlacedGrid, voxel_m: float) -> tuple[float, float]:
    """Return a sort key: grids with other cells than `voxel_m`, or a far reach, come last."""
    cell_m = one.layer.resolution_m
    return max(cell_m / voxel_m, voxel_m / cell_m), float(np.abs(one.corners).max())


def _bounds(placed: Sequence[_PlacedGrid]) -> NDArray[np.float64]:
    """Return the lowest column and row of the grids, and the ends (2, 2), in the finest cells."""
    corners = np.concatenate([one.corners for one in placed])
    cell_m = min(one.layer.resolution_m for one in placed)
    return np.array([np.floor(corners.min(axis=0) / cell_m), np.ceil(corners.max(axis=0) / cell_m)])


def _fuse_grids(placed: Sequence[_PlacedGrid]) -> GridLayer | None:
    """Return the sum of the grids' log odds in `map`, at the finest grid's resolution."""
    if not placed:
        return None
    resolution_m = min(one.layer.resolution_m for one in placed)
    low, end = _bounds(placed)
    columns, rows = (end - low).astype(int)
    origin_xy_m = (float(low[0] * resolution_m), float(low[1] * resolution_m))
    total = np.zeros((rows, columns), np.float32)
    for one in placed:
        total += resampled(one.T_map_local, one.layer, origin_xy_m, resolution_m, (columns, rows))
    np.clip(total, -_LOG_ODDS_LIMIT, _LOG_ODDS_LIMIT, out=total)
    return GridLayer(log_odds=total, resolution_m=resolution_m, origin_xy_m=origin_xy_m)
