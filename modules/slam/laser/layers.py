"""The map layers of a session: grid, points, pose graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.maps import MapLayers, PointLayer, PoseGraphLayer
from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Matrix, apply, spatial_covariance, to_transform, to_transforms

from ..grid import OccupancyGrid
from .keyframes import ScanKeyframes
from .pose_graph import ScanEdge

_LEVEL_DEVIATION = 0.01  # m and rad: standard deviation of z, roll and pitch on a floor


def map_layers(
    keyframes: ScanKeyframes, edges: Sequence[ScanEdge] | None, *, resolution_m: float
) -> MapLayers:
    """Return grid, points and pose graph of the keyframes, in `local`; edges None: no graph."""
    reader = keyframes.reader
    grid = OccupancyGrid(resolution_m)
    clouds = [np.zeros((0, 2))]
    for number, keyframe in enumerate(keyframes.frames):
        T_local_laser = to_transform(keyframe.T_local_base) @ reader.T_base_laser
        grid.insert(T_local_laser, _cut(keyframe.scan, reader.range_max_m))
        clouds.append(apply(keyframe.T_local_base, keyframes.surfaces_base(number).points))
    points = _thin(np.concatenate(clouds), resolution_m)
    heights = np.full(len(points), reader.T_base_laser[2, 3])
    cloud = np.column_stack([points, heights]).astype(np.float32)
    return MapLayers(
        points=PointLayer(points=cloud),
        grid=grid.layer(),
        pose_graph=None if edges is None else _graph(keyframes, edges),
    )


def covariance_6(covariance: Matrix) -> NDArray[np.float64]:
    """Return the (6, 6) covariance of se3.log from that of (x, y, yaw), same axes."""
    return spatial_covariance(covariance, level=_LEVEL_DEVIATION**2)


def _graph(keyframes: ScanKeyframes, edges: Sequence[ScanEdge]) -> PoseGraphLayer:
    information = [np.linalg.inv(covariance_6(edge.covariance)) for edge in edges]
    return PoseGraphLayer(
        stamps_ns=np.array([frame.stamp_ns for frame in keyframes.frames], np.int64),
        T_world_base=to_transforms(keyframes.poses),
        edges=np.array([(e.first, e.second) for e in edges], np.int64).reshape(-1, 2),
        T_from_to=to_transforms([edge.T_first_second for edge in edges]),
        information=np.array(information).reshape(-1, 6, 6),
        is_loop=np.array([edge.is_loop for edge in edges], dtype=bool),
    )


def _cut(scan: LaserScan, range_max_m: float) -> LaserScan:
    """Return the scan without returns beyond `range_max_m`."""
    far = scan.ranges_m > range_max_m
    ranges = np.where(far & np.isfinite(scan.ranges_m), np.inf, scan.ranges_m)
    return replace(scan, ranges_m=ranges.astype(np.float32))


def _thin(points: NDArray[np.float64], cell_m: float) -> NDArray[np.float64]:
    """Return the first point per square of `cell_m`, (M, 2) [m], in their order."""
    cells = np.floor(points / cell_m).astype(np.int64)
    if not len(cells):
        return points
    columns = int(np.ptp(cells[:, 0])) + 1
    flat = (cells[:, 1] - cells[:, 1].min()) * columns + cells[:, 0] - cells[:, 0].min()
    _, first = np.unique(flat, return_index=True)
    return np.asarray(points[np.sort(first)])
