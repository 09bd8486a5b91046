"""Join the pose graphs and landmarks of all sessions in `map`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sceneslam.types import se3
from sceneslam.types.maps import LandmarkLayer, PoseGraphLayer
from sceneslam.types.se3 import Transform


def join_pose_graphs(placed: Sequence[tuple[Transform, PoseGraphLayer]]) -> PoseGraphLayer | None:
    """Return one graph in `map`, the nodes of a session after those of the one before it.

    Sessions stay unconnected: they are linked by T_map_local, which is not a measurement.
    """
    if not placed:
        return None
    graphs = [graph for _, graph in placed]
    before = np.cumsum([0, *(len(graph.stamps_ns) for graph in graphs)])
    return PoseGraphLayer(
        stamps_ns=np.concatenate([graph.stamps_ns for graph in graphs]),
        T_world_base=np.concatenate([T @ graph.T_world_base for T, graph in placed]),
        edges=np.concatenate(
            [graph.edges + start for graph, start in zip(graphs, before, strict=False)]
        ),
        T_from_to=np.concatenate([graph.T_from_to for graph in graphs]),
        information=np.concatenate([graph.information for graph in graphs]),
        is_loop=np.concatenate([graph.is_loop for graph in graphs]),
    )


def join_landmarks(placed: Sequence[tuple[Transform, LandmarkLayer]]) -> LandmarkLayer | None:
    """Return all sessions' landmarks (N, 3) [m], map; shared landmarks occur once per session."""
    if not placed:
        return None
    layers = [layer for _, layer in placed]
    points = [se3.apply(T, layer.points).astype(np.float32) for T, layer in placed]
    return LandmarkLayer(
        points=np.concatenate(points),
        first_stamps_ns=np.concatenate([layer.first_stamps_ns for layer in layers]),
        sightings=np.concatenate([layer.sightings for layer in layers]),
    )
