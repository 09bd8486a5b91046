"""Export of a saved map to the formats of map_server, g2o and TUM."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.save import save_grid, save_pose_graph
from sceneslam.graphs.edge import EdgeKind
from sceneslam.types.maps import PoseGraphLayer


def export(saved: SavedMap, folder: Path) -> list[Path]:
    """Write `grid.pgm`, `grid.yaml`, `pose_graph.g2o` and `.tum` of the first piece."""
    folder.mkdir(parents=True, exist_ok=True)
    main = saved.of(np.flatnonzero(saved.pieces == 0).tolist())
    grid, graph = folder / "grid.yaml", folder / "pose_graph.g2o"
    save_grid(grid_of(main.plan()), grid)
    save_pose_graph(_graph(main), graph)
    return [grid, grid.with_suffix(".pgm"), graph, graph.with_suffix(".tum")]


def _graph(saved: SavedMap) -> PoseGraphLayer:
    stamps = np.array([submap.stamps_ns[0] for submap in saved.submaps], np.int64)
    return PoseGraphLayer(
        stamps_ns=stamps,
        T_world_base=saved.T_map_node,
        edges=np.array([(edge.first, edge.second) for edge in saved.edges], np.int64).reshape(
            -1, 2
        ),
        T_from_to=np.array([edge.T_first_second for edge in saved.edges]).reshape(-1, 4, 4),
        information=np.array([np.linalg.inv(edge.covariance) for edge in saved.edges]).reshape(
            -1, 6, 6
        ),
        is_loop=np.array([edge.kind is EdgeKind.LOOP for edge in saved.edges], bool),
    )
