"""Export of a saved map to the formats of map_server, g2o and TUM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.save import save_grid, save_pose_graph
from sceneslam.atlas.submaps.graph import EdgeKind
from sceneslam.types import planar
from sceneslam.types.maps import PoseGraphLayer

_UNMEASURED = 1e6  # 1/m^2, 1/rad^2: information of height, roll and pitch, which are 0


def export(saved: SavedMap, folder: Path) -> list[Path]:
    """Write `grid.pgm`, `grid.yaml`, `pose_graph.g2o` and `.tum` of the first piece."""
    folder.mkdir(parents=True, exist_ok=True)
    main = saved.of(np.flatnonzero(saved.pieces == 0).tolist())
    grid, graph = folder / "grid.yaml", folder / "pose_graph.g2o"
    save_grid(grid_of(main.plan()), grid)
    save_pose_graph(_graph(main), graph)
    return [grid, graph]


def _graph(saved: SavedMap) -> PoseGraphLayer:
    stamps = np.array([submap.stamps_ns[0] for submap in saved.submaps], np.int64)
    return PoseGraphLayer(
        stamps_ns=stamps,
        T_world_base=planar.to_transforms(saved.T_map_node),
        edges=np.array([(edge.first, edge.second) for edge in saved.edges], np.int64).reshape(
            -1, 2
        ),
        T_from_to=planar.to_transforms([edge.T_first_second for edge in saved.edges]),
        information=np.array([_information(edge.covariance) for edge in saved.edges]).reshape(
            -1, 6, 6
        ),
        is_loop=np.array([edge.kind is EdgeKind.LOOP for edge in saved.edges], bool),
    )


def _information(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    return planar.spatial_covariance(np.asarray(np.linalg.inv(covariance)), level=_UNMEASURED)
