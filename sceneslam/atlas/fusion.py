"""Fuses the maps of all sessions into one: points side by side, grids summed as log odds."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.graph import join_landmarks, join_pose_graphs
from sceneslam.types import se3
from sceneslam.types.maps import GridLayer, HybridMap, MapLayers, PointLayer
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)
_GREY = 160  # colour of points that no camera saw
_CELLS_MAX = 10**8  # 500 m x 500 m at 5 cm: 400 MB during the fusion
_LOG_ODDS_LIMIT = 10.0  # limited, so that a cell can still change after many sessions

Placed = tuple[str, Transform, MapLayers]  # module, T_map_local, its layers in `local`


def fuse(placed: Sequence[Placed], *, voxel_m: float) -> HybridMap:
    """Return one map of all layers; points are thinned to one per module and voxel."""
    modules = tuple(dict.fromkeys(module for module, _, _ in placed))
    points, colors, owners = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)], []
    for module, T_map_local, layers in placed:
        if layers.points is None or not len(layers.points.points):
            continue
        layer = layers.points
        points.append(se3.apply(T_map_local, layer.points).astype(np.float32))
        grey = np.full((len(layer.points), 3), _GREY, np.uint8)
        colors.append(grey if layer.colors_bgr is None else layer.colors_bgr)
        owners.append(np.full(len(layer.points), modules.index(module), np.uint8))
    cloud, color = np.concatenate(points), np.concatenate(colors)
    owner = np.concatenate([np.zeros(0, np.uint8), *owners])
    keep = one_per_voxel(cloud, owner, voxel_m)
    graphs = [(n, T, m.pose_graph) for n, T, m in placed if m.pose_graph is not None]
    landmarks = [(n, T, m.landmarks) for n, T, m in placed if m.landmarks is not None]
    return HybridMap(
        points=PointLayer(points=cloud[keep], colors_bgr=color[keep]),
        point_modules=owner[keep],
        modules=modules,
        grid=_fuse_grids([(T, m.grid) for _, T, m in placed if m.grid is not None]),
        pose_graph=join_pose_graphs([(T, graph) for _, T, graph in graphs]),
        node_modules=_owners([(n, len(graph.stamps_ns)) for n, _, graph in graphs], modules),
        landmarks=join_landmarks([(T, layer) for _, T, layer in landmarks]),
        landmark_modules=_owners([(n, len(layer.points)) for n, _, layer in landmarks], modules),
    )


def _owners(
    counts: Sequence[tuple[str, int]], modules: tuple[str, ...]
) -> NDArray[np.uint8] | None:
    """Return each row's module index; `counts` gives the number of rows per module, in order."""
    if not counts:
        return None
    numbers = np.array([modules.index(name) for name, _ in counts], np.uint8)
    return np.repeat(numbers, [count for _, count in counts])


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


def _fuse_grids(placed: Sequence[tuple[Transform, GridLayer]]) -> GridLayer | None:
    """Return the sum of the grids' log odds in `map`, at the finest grid's resolution."""
    placed = [(T, grid) for T, grid in placed if grid.log_odds.size]
    if not placed:
        return None
    resolution_m = min(grid.resolution_m for _, grid in placed)
    corners = np.concatenate([_corners_map(T, grid) for T, grid in placed])
    low = np.floor(corners.min(axis=0) / resolution_m).astype(int)
    columns, rows = np.ceil(corners.max(axis=0) / resolution_m).astype(int) - low
    origin_xy_m = (float(low[0] * resolution_m), float(low[1] * resolution_m))
    if rows * columns > _CELLS_MAX:
        _log.warning("the grids lie too far apart for one: it would have %d x %d", columns, rows)
        return None
    total = np.zeros((rows, columns), np.float32)
    for T_map_local, grid in placed:
        total += _resample(T_map_local, grid, origin_xy_m, resolution_m, (columns, rows))
    np.clip(total, -_LOG_ODDS_LIMIT, _LOG_ODDS_LIMIT, out=total)
    return GridLayer(log_odds=total, resolution_m=resolution_m, origin_xy_m=origin_xy_m)


def _corners_map(T_map_local: Transform, grid: GridLayer) -> NDArray[np.float64]:
    rows, columns = grid.log_odds.shape
    low = np.array(grid.origin_xy_m)
    high = low + grid.resolution_m * np.array([columns, rows])
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [*high]])
    T = _planar(T_map_local)
    return np.asarray(corners @ T[:2, :2].T + T[:2, 3])


def _resample(
    T_map_local: Transform,
    grid: GridLayer,
    origin_xy_m: tuple[float, float],
    resolution_m: float,
    size_wh: tuple[int, int],
) -> NDArray[np.float32]:
    """Return the grid's log odds at the centres of the map's cells (nearest cell)."""
    T = se3.inverse(_planar(T_map_local))
    # Cell indices of the map -> metres in map -> metres in local -> cell indices of the grid.
    scale = resolution_m / grid.resolution_m
    centre = np.array(origin_xy_m) + resolution_m / 2
    offset = T[:2, :2] @ centre + T[:2, 3] - np.array(grid.origin_xy_m) - grid.resolution_m / 2
    affine = np.column_stack([scale * T[:2, :2], offset / grid.resolution_m])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(grid.log_odds, affine, size_wh, flags=flags), np.float32)


def _planar(T_map_local: Transform) -> Transform:
    """Return the planar part (x, y, yaw) of a transform."""
    return se3.from_xy_yaw(T_map_local[0, 3], T_map_local[1, 3], se3.yaw_rad(T_map_local))
