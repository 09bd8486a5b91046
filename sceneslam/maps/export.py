"""Export of a saved map to the formats of map_server, g2o and TUM."""

from __future__ import annotations

from pathlib import Path

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.save import save_grid, save_pose_graph


def export(saved: SavedMap, folder: Path) -> list[Path]:
    """Write `grid.pgm`, `grid.yaml`, `pose_graph.g2o` and `.tum` of the first piece."""
    main = saved.of(saved.nodes())
    grid, graph = folder / "grid.yaml", folder / "pose_graph.g2o"
    save_grid(grid_of(main.plan()), grid)
    save_pose_graph(main.graph(), graph)
    return [grid, grid.with_suffix(".pgm"), graph, graph.with_suffix(".tum")]
