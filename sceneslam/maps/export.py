"""Export of a saved map to the formats of map_server, g2o and TUM."""

from __future__ import annotations

from pathlib import Path

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.save import save_grid, save_nodes, save_pose_graph


def export(saved: SavedMap, folder: Path) -> list[Path]:
    """Write `grid.pgm`, `grid.yaml` and `pose_graph.g2o` of the first piece.

    The graph's vertices are the poses in `run_0.tum`, `run_1.tum` and so on, one after another:
    stamps of two runs may be the same.
    """
    main = saved.of(saved.nodes())
    grid, graph = folder / "grid.yaml", folder / "pose_graph.g2o"
    save_grid(grid_of(main.plan()), grid)
    save_pose_graph(main.graph(), graph)
    written = [grid, grid.with_suffix(".pgm"), graph]
    for run in sorted({submap.run for submap in main.submaps}):
        own = [node for node, submap in enumerate(main.submaps) if submap.run == run]
        written.append(folder / f"run_{run}.tum")
        save_nodes(main.of(own).graph(), written[-1])
    return written
