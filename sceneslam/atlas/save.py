"""Writes the map: points as PLY, the grid as map_server's PGM and YAML."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sceneslam.types.maps import GridLayer, HybridMap

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # map_server's own defaults


def save_map(hybrid: HybridMap, folder: Path) -> None:
    """Write `points.ply` and, where a module built a grid, `grid.pgm` and `grid.yaml`."""
    folder.mkdir(parents=True, exist_ok=True)
    save_points(hybrid, folder / "points.ply")
    if hybrid.grid is not None:
        save_grid(hybrid.grid, folder / "grid.yaml")


def save_points(hybrid: HybridMap, path: Path) -> None:
    """Write a binary PLY: x y z [m, map], red green blue, and the index of the module."""
    fields = [(axis, "<f4") for axis in "xyz"]
    fields += [(color, "u1") for color in ("red", "green", "blue", "module")]
    rows = np.zeros(len(hybrid.points.points), dtype=fields)
    for index, axis in enumerate("xyz"):
        rows[axis] = hybrid.points.points[:, index]
    if hybrid.points.colors_bgr is not None:
        for index, color in enumerate(("blue", "green", "red")):
            rows[color] = hybrid.points.colors_bgr[:, index]
    rows["module"] = hybrid.point_modules
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment module {i} {name}" for i, name in enumerate(hybrid.modules)]
    header += [f"element vertex {len(rows)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {color}" for color in ("red", "green", "blue", "module")]
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(rows.tobytes())


def save_grid(grid: GridLayer, path: Path) -> None:
    """Write the grid for map_server: black occupied, white free, grey unknown; y points up."""
    occupied = 1.0 / (1.0 + np.exp(-grid.log_odds.astype(np.float64)))
    image = np.full(grid.log_odds.shape, 205, np.uint8)
    image[occupied > OCCUPIED_THRESHOLD] = 0
    image[occupied < FREE_THRESHOLD] = 254
    rows, columns = grid.log_odds.shape
    with path.with_suffix(".pgm").open("wb") as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode())
        file.write(np.flipud(image).tobytes())
    x_m, y_m = grid.origin_xy_m
    path.write_text(
        f"image: {path.with_suffix('.pgm').name}\n"
        f"resolution: {grid.resolution_m:g}\n"
        f"origin: [{x_m:.6f}, {y_m:.6f}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
        f"free_thresh: {FREE_THRESHOLD}\n"
    )
