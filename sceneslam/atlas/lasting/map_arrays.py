"""A saved map as arrays, and back; `docs/map.md` says what each of them is."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import FloorPlan
from sceneslam.atlas.submaps.submap import Drawing, Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.views.view import Landmarks, PlacedView

_FAR_M = 1e5  # no building is so large
_ROUNDING = 1e-6  # of a rotation that was composed of many
_STRAIGHT = 1e-3  # of the length of a direction
_SHAPES: Mapping[str, tuple[str, str, tuple[int, ...]]] = {  # name -> dtype, row of, inner shape
    "node_run": ("<i8", "submaps", ()),
    "node_session": ("<i8", "submaps", ()),
    "node_module": ("<i8", "submaps", ()),
    "node_piece": ("<i8", "submaps", ()),
    "node_pose": ("<f8", "submaps", (4, 4)),
    "node_up": ("<f8", "submaps", (3,)),
    "node_scans": ("<i8", "submaps", ()),
    "node_points": ("<i8", "submaps", ()),
    "node_views": ("<i8", "submaps", ()),
    "node_grid_shape": ("<i8", "submaps", (2,)),
    "node_grid_origin": ("<f8", "submaps", (2,)),
    "scan_stamp_ns": ("<i8", "scans", ()),
    "scan_pose": ("<f8", "scans", (3,)),
    "point": ("<f4", "points", (2,)),
    "normal": ("<f4", "points", (2,)),
    "free_bits": ("|u1", "bytes", ()),
    "view_stamp_ns": ("<i8", "views", ()),
    "view_pose": ("<f8", "views", (4, 4)),
    "view_landmarks": ("<i8", "views", ()),
    "landmark": ("<f4", "landmarks", (3,)),
    "landmark_deviation": ("<f4", "landmarks", ()),
    "descriptor": ("|u1", "landmarks", (32,)),
    "edge_nodes": ("<i8", "edges", (2,)),
    "edge_motion": ("<f8", "edges", (4, 4)),
    "edge_covariance": ("<f8", "edges", (6, 6)),
    "edge_kind": ("<i8", "edges", ()),
}


def arrays_of(saved: SavedMap, modules: list[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a map; `modules` are all that its submaps name."""
    submaps, edges = saved.submaps, saved.edges
    plans = [submap.plan for submap in submaps]
    stamps = [stamp for submap in submaps for stamp in submap.stamps_ns.tolist()]
    views = [view for submap in submaps for view in submap.views]
    seen = [view.landmarks for view in views]
    columns: dict[str, Any] = {
        "node_run": [submap.run for submap in submaps],
        "node_session": [submap.session for submap in submaps],
        "node_module": [modules.index(submap.module) for submap in submaps],
        "node_piece": saved.pieces,
        "node_pose": saved.T_map_node,
        "node_up": [np.zeros(3) if submap.up is None else submap.up for submap in submaps],
        "node_scans": [len(submap.stamps_ns) for submap in submaps],
        "node_points": [len(plan) for plan in plans],
        "node_views": [len(submap.views) for submap in submaps],
        "node_grid_shape": [plan.free.shape for plan in plans],
        "node_grid_origin": [plan.origin_xy_m for plan in plans],
        "scan_stamp_ns": stamps,
        "scan_pose": _joined([submap.T_submap_base for submap in submaps]),
        "point": _joined([plan.points for plan in plans]),
        "normal": _joined([plan.normals for plan in plans]),
        "free_bits": _joined([np.packbits(plan.free) for plan in plans]),
        "view_stamp_ns": [view.stamp_ns for view in views],
        "view_pose": [view.T_submap_cam for view in views],
        "view_landmarks": [len(landmarks) for landmarks in seen],
        "landmark": _joined([one.points_cam for one in seen]),
        "landmark_deviation": _joined([one.deviation_m for one in seen]),
        "descriptor": _joined([one.descriptors for one in seen]),
        "edge_nodes": [(edge.first, edge.second) for edge in edges],
        "edge_motion": [edge.T_first_second for edge in edges],
        "edge_covariance": [edge.covariance for edge in edges],
        "edge_kind": [int(edge.kind) for edge in edges],
    }
    arrays = {
        name: np.asarray(columns[name], np.dtype(dtype)).reshape(-1, *inner)
        for name, (dtype, _, inner) in _SHAPES.items()
    }
    for name in ("node_pose", "view_pose", "edge_motion"):
        if not _are_rigid(arrays[name]):  # modules report rotations that are rounded
            T, quats_xyzw = arrays[name], se3.to_quat_xyzw(arrays[name])
            arrays[name] = se3.from_quat_xyzw(T[:, :3, 3], quats_xyzw)
    return arrays


def packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an npz whose bytes depend on the arrays alone, not on the time."""
    buffer = io.BytesIO()
    rows: dict[str, Any] = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    np.savez_compressed(buffer, **rows)
    return buffer.getvalue()


def check_arrays(arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Raise InputError if the arrays are inconsistent."""
    counts: dict[str, int] = {}
    for name, (dtype, rows, inner) in _SHAPES.items():
        found = arrays.get(name)
        if found is None:
            raise InputError(f"{name}: missing among the map's arrays: {path}")
        if found.dtype.str != dtype or found.ndim == 0 or found.shape[1:] != inner:
            expected = f"{dtype} of shape (N, {', '.join(map(str, inner))})"
            raise InputError(
                f"{name}: expected {expected}, got {found.dtype.str} {found.shape}: {path}"
            )
        if not np.isfinite(found).all():
            raise InputError(f"{name}: expected finite numbers: {path}")
        if inner == (4, 4) and not _are_rigid(found):
            raise InputError(f"{name}: expected rotations and translations: {path}")
        if counts.setdefault(rows, len(found)) != len(found):
            raise InputError(f"{name}: expected {counts[rows]} rows, got {len(found)}: {path}")
    for name in ("node_run", "node_module", "node_piece", "node_grid_shape"):
        if (arrays[name] < 0).any():
            raise InputError(f"{name}: expected 0 or more: {path}")
    if (arrays["landmark_deviation"] <= 0.0).any():
        raise InputError(f"landmark_deviation: expected above 0: {path}")
    for name in ("node_pose", "node_grid_origin", "scan_pose", "point", "view_pose", "landmark"):
        if np.abs(arrays[name]).max(initial=0.0) > _FAR_M:
            raise InputError(f"{name}: expected at most {_FAR_M:g} m: {path}")
    lengths = np.linalg.norm(arrays["node_up"], axis=1)
    if not ((lengths == 0.0) | (np.abs(lengths - 1.0) < _STRAIGHT)).all():
        raise InputError(f"node_up: expected directions of length 1, or 0: {path}")
    if counts["submaps"] and arrays["node_piece"].min() != 0:
        raise InputError(f"node_piece: expected a submap in piece 0: {path}")
    if (arrays["node_scans"] == 0).any():
        raise InputError(f"node_scans: expected a scan in every submap: {path}")
    if len(arrays["edge_covariance"]) and not _are_positive(arrays["edge_covariance"]):
        raise InputError(f"edge_covariance: expected positive definite matrices: {path}")
    sizes = -(-arrays["node_grid_shape"].prod(axis=1, dtype=np.float64) // 8)
    totals = {
        "scans": arrays["node_scans"],
        "points": arrays["node_points"],
        "bytes": sizes,
        "views": arrays["node_views"],
        "landmarks": arrays["view_landmarks"],
    }
    for rows, parts in totals.items():
        if (parts < 0).any() or int(parts.sum()) != counts[rows]:
            raise InputError(f"the submaps' {rows} do not add up to {counts[rows]}: {path}")
    nodes, kinds = arrays["edge_nodes"], arrays["edge_kind"]
    if len(nodes) and not (nodes.min() >= 0 and nodes.max() < counts["submaps"]):
        raise InputError(f"edge_nodes: expected 0 to {counts['submaps'] - 1}: {path}")
    if not np.isin(kinds, [kind.value for kind in EdgeKind]).all():
        raise InputError(f"edge_kind: expected 0 to {max(EdgeKind)}: {path}")


def map_of(arrays: Mapping[str, NDArray[Any]], modules: list[str]) -> SavedMap:
    """Return the map of arrays that were checked, of the same `modules`."""

    def parts(name: str, sizes: NDArray[Any]) -> list[NDArray[Any]]:
        return np.split(arrays[name], np.cumsum(sizes)[:-1]) if len(sizes) else []

    shapes, scans, points = (
        arrays[name] for name in ("node_grid_shape", "node_scans", "node_points")
    )
    free_bits = parts("free_bits", -(-shapes.prod(axis=1) // 8))
    ends = np.cumsum(arrays["node_views"])
    views = [
        PlacedView(
            stamp_ns=stamp_ns,
            T_submap_cam=T,
            landmarks=Landmarks(points_cam=points, deviation_m=deviation_m, descriptors=bits),
        )
        for stamp_ns, T, points, deviation_m, bits in zip(
            arrays["view_stamp_ns"].tolist(),
            arrays["view_pose"],
            parts("landmark", arrays["view_landmarks"]),
            parts("landmark_deviation", arrays["view_landmarks"]),
            parts("descriptor", arrays["view_landmarks"]),
            strict=True,
        )
    ]
    rows = zip(
        parts("scan_stamp_ns", scans),
        parts("scan_pose", scans),
        parts("point", points),
        parts("normal", points),
        free_bits,
        (ends - arrays["node_views"]).tolist(),
        ends.tolist(),
        strict=True,
    )
    submaps = []
    for index, (stamps_ns, poses, walls, normals, free, start, end) in enumerate(rows):
        shape = tuple(shapes[index].tolist())
        x_m, y_m = arrays["node_grid_origin"][index].tolist()
        cells = np.unpackbits(free, count=int(np.prod(shape))).reshape(shape).astype(bool)
        submaps.append(
            Submap(
                run=int(arrays["node_run"][index]),
                session=int(arrays["node_session"][index]),
                module=modules[int(arrays["node_module"][index])],
                stamps_ns=stamps_ns,
                T_submap_base=poses,
                drawing=Drawing(
                    FloorPlan(points=walls, normals=normals, free=cells, origin_xy_m=(x_m, y_m))
                ),
                views=tuple(views[start:end]),
                up=arrays["node_up"][index] if arrays["node_up"][index].any() else None,
            )
        )
    edges = [
        Edge(
            first=int(nodes[0]),
            second=int(nodes[1]),
            T_first_second=motion,
            covariance=covariance,
            kind=EdgeKind(int(kind)),
        )
        for nodes, motion, covariance, kind in zip(
            arrays["edge_nodes"],
            arrays["edge_motion"],
            arrays["edge_covariance"],
            arrays["edge_kind"],
            strict=True,
        )
    ]
    return SavedMap(
        submaps=tuple(submaps),
        T_map_node=arrays["node_pose"],
        pieces=arrays["node_piece"],
        edges=tuple(edges),
    )


def _are_rigid(poses: NDArray[Any]) -> bool:
    """Tell whether matrices (N, 4, 4) are rotations with translations."""
    rotations = poses[:, :3, :3]
    gram = rotations @ rotations.transpose(0, 2, 1)
    is_straight = np.abs(gram - np.eye(3)).max(initial=0.0) < _ROUNDING
    return bool(is_straight and (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all())


def _are_positive(covariances: NDArray[Any]) -> bool:
    """Tell whether matrices (N, 6, 6) are symmetric and positive definite."""
    turned = covariances.transpose(0, 2, 1)
    is_symmetric = np.abs(covariances - turned).max() <= _ROUNDING * np.abs(covariances).max()
    return bool(is_symmetric and (np.linalg.eigvalsh(covariances) > 0.0).all())


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    return np.concatenate(parts) if parts else np.zeros(0)
