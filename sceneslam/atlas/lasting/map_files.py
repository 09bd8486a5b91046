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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from sceneslam.atlas.lasting.map_arrays import arrays_of, check_arrays, map_of, packed
from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import CELL_M
from sceneslam.types.errors import InputError, text_of
from sceneslam.types.files import PART, whole

HEAD, FORMAT, VERSION = "map.yaml", "sceneslam-map", 5
OLD = "map.old.yaml"  # the head of a map that another one took the place of
_ARRAYS = "arrays-"  # prefix, followed by the start of their checksum


def check_map_folder(folder: Path) -> None:
    """Raise InputError if a map cannot be saved in a folder: it holds something else.

    Nor in a folder that cannot be made, nor in that of another map, which could not be saved again.
    """
    if seal_of(folder.absolute().parent) is not None:
        raise InputError(f"a map is saved in a folder of its own, not in another map: {folder}")
    if not folder.is_dir():
        there = next(path for path in (folder, *folder.parents) if os.path.lexists(path))
        if not there.is_dir():
            raise InputError(f"there is a file in the place of a folder: {there}")
        try:
            with TemporaryDirectory(dir=there) as within:  # a permission alone does not tell
                (Path(within) / folder.relative_to(there)).mkdir(parents=True)
        except OSError as error:
            raise InputError(f"it cannot be made in {there}: {error.strerror}") from error
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
    arrays = arrays_of(saved, modules)
    check_arrays(arrays, folder)
    folder.mkdir(parents=True, exist_ok=True)
    data = packed(arrays)
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
    check_arrays(arrays, path)
    modules = head.get("modules")
    if not isinstance(modules, list) or arrays["node_module"].max(initial=-1) >= len(modules):
        raise InputError(f"modules: expected the names that the submaps refer to: {folder / HEAD}")
    saved = map_of(arrays, [str(module) for module in modules])
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
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        which = "a newer SceneSLAM wrote it" if newer else f"only version {VERSION} is read"
        raise InputError(f"a map of version {version!r}, {which}: {path}")
    for key in ("arrays", "sha256"):
        if not isinstance(head.get(key), str):
            raise InputError(f"{key}: missing, the map's {HEAD} is not complete: {path}")
    if head.get("cell_m") != CELL_M:
        raise InputError(f"cell_m: got {head.get('cell_m')!r}, allowed: {CELL_M}: {path}")
    return head
