"""Writes the map: clouds as PLY, the grid as map_server's PGM and YAML, the pose graph as g2o."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import triangle
from sceneslam.types.files import replacing
from sceneslam.types.maps import (
    FREE_THRESHOLD,
    OCCUPIED_THRESHOLD,
    GridLayer,
    HybridMap,
    PoseGraphLayer,
)
from sceneslam.types.trajectory import Trajectory

_PLY_TYPES = {
    "float32": ("<f4", "float"),
    "float64": ("<f8", "double"),
    "int64": ("<i4", "int"),
    "uint8": ("u1", "uchar"),
}


def save_map(hybrid: HybridMap, folder: Path) -> None:
    """Write `points.ply` and, if the modules built them, the grid, pose graph and landmarks.

    `grid.pgm` and `grid.yaml`; `pose_graph.g2o`, whose vertices are the poses in `pose_graph.tum`,
    in that order; `landmarks.ply`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_points(hybrid, folder / "points.ply")
    if hybrid.grid is not None:
        save_grid(hybrid.grid, folder / "grid.yaml")
    if hybrid.pose_graph is not None:
        save_pose_graph(hybrid.pose_graph, folder / "pose_graph.g2o")
        save_nodes(hybrid.pose_graph, folder / "pose_graph.tum")
    save_landmarks(hybrid, folder / "landmarks.ply")


def save_points(hybrid: HybridMap, path: Path) -> None:
    """Write a binary PLY: x y z [m, map], red green blue, and the index of the module."""
    columns: dict[str, NDArray[Any]] = _axes(hybrid.points.points)
    colors_bgr = hybrid.points.colors_bgr
    if colors_bgr is None:
        colors_bgr = np.zeros((len(hybrid.points.points), 3), np.uint8)
    columns |= dict(zip(("red", "green", "blue"), colors_bgr[:, ::-1].T, strict=True))
    _write_ply(path, columns | {"module": hybrid.point_modules}, hybrid.modules)


def save_landmarks(hybrid: HybridMap, path: Path) -> None:
    """Write landmarks, if any, as PLY: x y z [m, map], stamp [s] first seen, sightings, module."""
    layer, owners = hybrid.landmarks, hybrid.landmark_modules
    if layer is None or owners is None:
        return
    first_seen_s = layer.first_stamps_ns / 1e9
    columns = _axes(layer.points) | {"first_seen_s": first_seen_s, "sightings": layer.sightings}
    _write_ply(path, columns | {"module": owners}, hybrid.modules)


def save_pose_graph(graph: PoseGraphLayer, path: Path) -> None:
    """Write the graph as g2o, information in the order translation, rotation vector.

    So gtsam and Ceres read it; g2o itself reads that of the quaternion's vector part, half the
    angle.
    """
    with replacing(path) as file:
        for row, numbers in enumerate(_quat_rows(graph.T_world_base)):
            file.write(f"VERTEX_SE3:QUAT {row} {numbers}\n")
        upper = triangle(graph.information).tolist()
        measured = zip(graph.edges.tolist(), _quat_rows(graph.T_from_to), upper, strict=True)
        for (start, end), numbers, weights in measured:
            words = " ".join(f"{weight:.9g}" for weight in weights)
            file.write(f"EDGE_SE3:QUAT {start} {end} {numbers} {words}\n")


def save_nodes(graph: PoseGraphLayer, path: Path) -> None:
    """Write the poses of a graph with their stamps as TUM."""
    Trajectory(stamps_ns=graph.stamps_ns, T_world_base=graph.T_world_base).write_tum(path)


def save_grid(grid: GridLayer, path: Path) -> None:
    """Write the grid for map_server: black occupied, white free, grey unknown; y points up."""
    image = grid.trinary(occupied=0, free=254, unknown=205).astype(np.uint8)
    rows, columns = image.shape
    with replacing(path.with_suffix(".pgm"), "wb") as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode())
        file.write(np.flipud(image).tobytes())
    x_m, y_m = grid.origin_xy_m
    with replacing(path) as file:
        file.write(
            f"image: {path.with_suffix('.pgm').name}\n"
            f"resolution: {grid.resolution_m:g}\n"
            f"origin: [{x_m:.6f}, {y_m:.6f}, 0.0]\n"
            "negate: 0\n"
            f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
            f"free_thresh: {FREE_THRESHOLD}\n"
        )


def _axes(points: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))


def _write_ply(path: Path, columns: Mapping[str, NDArray[Any]], modules: Sequence[str]) -> None:
    """Write a binary PLY of one vertex per row."""
    fields = [(name, _PLY_TYPES[column.dtype.name]) for name, column in columns.items()]
    rows = np.zeros(len(columns["x"]), [(name, code) for name, (code, _) in fields])
    for name, column in columns.items():
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment module {i} {name}" for i, name in enumerate(modules)]
    header += [f"element vertex {len(rows)}"]
    header += [f"property {word} {name}" for name, (_, word) in fields]
    with replacing(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(rows.tobytes())


def _quat_rows(T_a_b: NDArray[np.float64]) -> list[str]:
    """Return `x y z qx qy qz qw` of every transform (N, 4, 4)."""
    rows = np.concatenate([T_a_b[:, :3, 3], se3.to_quat_xyzw(T_a_b)], axis=1)
    return [" ".join(f"{number:.9g}" for number in row) for row in rows.tolist()]
