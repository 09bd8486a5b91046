"""Write and read a saved map: a YAML with the name and checksum of one file of arrays.

`docs/map.md` documents the format. The arrays are written first, under a new name; the YAML that
names them is replaced atomically. If the process is killed meanwhile, the old map remains. The
folder is locked while it is read or written, so that runs may share it.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import CELL_M, FloorPlan
from sceneslam.atlas.submaps.submap import Drawing, Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import se3
from sceneslam.types.errors import InputError, text_of
from sceneslam.types.files import PART, whole
from sceneslam.views.view import Landmarks, PlacedView, depth_noise_m

HEAD, FORMAT, VERSION = "map.yaml", "sceneslam-map", 4
_OLDEST = 2  # that is read; it has no `node_up`, as 3 no `landmark_deviation`
OLD = "map.old.yaml"  # the head of a map that another one took the place of
_FAR_M = 1e5  # no building is so large
_ROUNDING = 1e-6  # of a rotation that was composed of many
_STRAIGHT = 1e-3  # of the length of a direction
_ARRAYS = "arrays-"  # prefix, followed by the start of their checksum
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


def check_map_folder(folder: Path) -> None:
    """Raise InputError if a map cannot be saved in a folder: it holds something else.

    Nor in a folder of another map, which could not be saved again.
    """
    if seal_of(folder.absolute().parent) is not None:
        raise InputError(f"a map is saved in a folder of its own, not in another map: {folder}")
    if not folder.is_dir():
        there = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
        if not there.is_dir():
            raise InputError(f"there is a file in the place of a folder: {there}")
        if not os.access(there, os.W_OK | os.X_OK):
            raise InputError(f"the folder may not be written: {there}")
        return
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"the folder may not be written: {folder}")
    others = [path for path in folder.iterdir() if not _is_ours(path)]
    if others:
        raise InputError(f"a map is saved in a folder of its own, {others[0].name} is in: {folder}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedFiles:
    """What became of a folder in which a map was saved."""

    seal: str  # checksum of the map
    displaced: str | None  # that of another map, which is kept: its head was copied to OLD


def save_map_files(saved: SavedMap, folder: Path, *, known: str | None = None) -> SavedFiles:
    """Write the map into its own folder; the same map gives the same bytes.

    `known` is the checksum of the map that this one takes the place of; any other is kept. Raises
    InputError if the folder holds something else or the map could not be loaded again, OSError if
    it cannot be written.
    """
    check_map_folder(folder)
    modules = sorted({submap.module for submap in saved.submaps})
    arrays = _arrays(saved, modules)
    _check(arrays, folder)
    folder.mkdir(parents=True, exist_ok=True)
    data = _packed(arrays)
    seal = hashlib.sha256(data).hexdigest()
    name = f"{_ARRAYS}{seal[:16]}.npz"
    head = {
        "format": FORMAT,
        "version": VERSION,
        "arrays": name,
        "sha256": seal,
        "cell_m": CELL_M,
        "submaps": len(saved.submaps),
        "edges": len(saved.edges),
        "runs": saved.run_count,
        "pieces": len(np.unique(saved.pieces)),
        "modules": modules,
    }
    with _locked(folder, fcntl.LOCK_EX):
        before = seal_of(folder)
        displaced = None if before in (known, seal) else before
        with whole(folder / name, "wb") as file:
            file.write(data)
        if displaced is not None:
            with whole(folder / OLD) as file:
                file.write((folder / HEAD).read_text())
        with whole(folder / HEAD) as file:
            yaml.safe_dump(head, file, sort_keys=False)
        kept = {HEAD, OLD, name, _head(folder / OLD).get("arrays")}
        for path in folder.iterdir():
            if _is_ours(path) and path.name not in kept:
                path.unlink()
    return SavedFiles(seal=seal, displaced=displaced)


def seal_of(folder: Path) -> str | None:
    """Return the checksum of the map in a folder, of whatever version, None without a map."""
    seal = _head(folder / HEAD).get("sha256")
    return None if seal is None else str(seal)


def _head(path: Path) -> dict[str, Any]:
    """Return a map's head, empty if the file is not one."""
    with suppress(OSError, ValueError, RecursionError, yaml.YAMLError):
        head = yaml.safe_load(path.read_text())
        if isinstance(head, dict) and head.get("format") == FORMAT:
            return head
    return {}


@contextmanager
def _locked(folder: Path, kind: int) -> Iterator[None]:
    """Hold a lock on a folder, where its file system has locks."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, kind)
        yield
    finally:
        os.close(handle)


def load_map_files(folder: Path) -> SavedMap:
    """Return the map of a folder; raises InputError that says what is wrong with it."""
    return read_map_files(folder)[0]


def read_map_files(folder: Path) -> tuple[SavedMap, str]:
    """Return the map of a folder with its checksum; raises InputError as `load_map_files` does."""
    if not folder.is_dir():
        raise InputError(f"there is no map, the folder is missing: {folder}")
    try:
        with _locked(folder, fcntl.LOCK_SH):
            head = _read_head(folder)
            path = folder / str(head["arrays"])
            if path.parent != folder or not path.is_file():
                raise InputError(f"the map is not complete, {head['arrays']} is missing: {folder}")
            data = path.read_bytes()
    except OSError as error:
        raise InputError(f"the map cannot be read ({text_of(error)}): {folder}") from error
    if hashlib.sha256(data).hexdigest() != head["sha256"]:
        raise InputError(f"the map is damaged, its checksum is another: {path}")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise InputError(f"the map's arrays cannot be read ({text_of(error)}): {path}") from error
    arrays = _of_older(arrays, head["version"]) | arrays
    _check(arrays, path)
    modules = head.get("modules")
    if not isinstance(modules, list) or arrays["node_module"].max(initial=-1) >= len(modules):
        raise InputError(f"modules: expected the names that the submaps refer to: {folder / HEAD}")
    saved = _unpacked(arrays, [str(module) for module in modules])
    counts = {"submaps": len(saved.submaps), "edges": len(saved.edges)}
    for key, count in counts.items():
        if head.get(key) != count:
            raise InputError(
                f"{key}: got {head.get(key)!r}, the arrays have {count}: {folder / HEAD}"
            )
    return saved, str(head["sha256"])


def _is_ours(path: Path) -> bool:
    """Tell whether a file is a map's; a head may also be that of another program."""
    name = path.name.removesuffix(PART)
    if name.startswith(_ARRAYS):
        return name.endswith(".npz")
    return name in (HEAD, OLD) and (path.name != name or bool(_head(path)))


def _read_head(folder: Path) -> dict[str, Any]:
    path = folder / HEAD
    if not path.is_file():
        raise InputError(f"not a map, it has no {HEAD}: {folder}")
    try:
        head = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, ValueError, OSError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"the map's {HEAD} cannot be read ({reason}): {path}") from error
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise InputError(f"not a map of SceneSLAM (format: {FORMAT} is missing): {path}")
    version = head.get("version")
    if version not in range(_OLDEST, VERSION + 1):
        newer = isinstance(version, int) and version > VERSION
        which = f"only versions {_OLDEST} to {VERSION} are known"
        which = "a newer SceneSLAM wrote it" if newer else which
        raise InputError(f"a map of version {version!r}, {which}: {path}")
    for key in ("arrays", "sha256"):
        if not isinstance(head.get(key), str):
            raise InputError(f"{key}: missing, the map's {HEAD} is not complete: {path}")
    if head.get("cell_m") != CELL_M:
        raise InputError(f"cell_m: got {head.get('cell_m')!r}, allowed: {CELL_M}: {path}")
    return head


def _of_older(arrays: Mapping[str, NDArray[Any]], version: int) -> dict[str, NDArray[Any]]:
    """Return what an older version lacks, as far as its other arrays are what they should be."""
    added = dict[str, NDArray[Any]]()
    if version < 3:
        added["node_up"] = np.zeros((np.size(arrays.get("node_run", ())), 3))
    landmark = arrays.get("landmark")
    if version < 4 and landmark is not None:  # a depth camera measured all of them
        is_sound = landmark.dtype == np.float32 and landmark.shape[1:] == (3,)
        far_m = np.linalg.norm(landmark.astype(float), axis=1) if is_sound else np.zeros(0)
        added["landmark_deviation"] = depth_noise_m(far_m).astype(np.float32)
    return added


def _check(arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
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
    sizes = -(-arrays["node_grid_shape"].prod(axis=1) // 8)
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


def _arrays(saved: SavedMap, modules: list[str]) -> dict[str, NDArray[Any]]:
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
        "view_pose": [view.T_submap_base for view in views],
        "view_landmarks": [len(landmarks.points_base) for landmarks in seen],
        "landmark": _joined([one.points_base for one in seen]),
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


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    return np.concatenate(parts) if parts else np.zeros(0)


def _packed(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return an npz whose bytes depend on the arrays alone, not on the time."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, array in arrays.items():
            part = io.BytesIO()
            np.lib.format.write_array(part, np.ascontiguousarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            file.writestr(entry, part.getvalue(), zipfile.ZIP_DEFLATED, 6)
    return buffer.getvalue()


def _unpacked(arrays: Mapping[str, NDArray[Any]], modules: list[str]) -> SavedMap:
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
            T_submap_base=T,
            landmarks=Landmarks(points_base=points, deviation_m=deviation_m, descriptors=bits),
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
