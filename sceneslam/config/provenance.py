"""Provenance of a run: configuration, versions, and hashes of code and input."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

import sceneslam
from sceneslam.config.check import map_folder
from sceneslam.types.errors import InputError
from sceneslam.types.files import replacing
from sceneslam.types.input_files import given_path

_EDGE_BYTES = 32 << 20  # of the beginning and end of large input files are hashed
_READERS = ("source", "effects", "detector", "slam")  # components that read files
_WRITTEN = ("record",)  # keys of files that a run writes
_CODE = (".py", ".so")
CACHES = "__pycache__"  # folders that Python writes beside its code


def save_config(config: Mapping[str, Any], path: Path) -> dict[str, str]:
    """Write the resolved configuration with its provenance; return the provenance."""
    made_by = provenance(config)
    lines = "".join(f"#   {key}: {value}\n" for key, value in made_by.items())
    text = OmegaConf.to_yaml(OmegaConf.create(dict(config)))
    with replacing(path) as file:
        file.write(f"# Resolved configuration. Made by:\n{lines}{text}")
    return made_by


def provenance(config: Mapping[str, Any]) -> dict[str, str]:
    """Return hashes and versions for a run of this configuration."""
    return {
        "config_sha256": _sha256(OmegaConf.to_yaml(OmegaConf.create(dict(config))).encode()),
        "code_sha256": code_sha256(),
        "input_sha256": input_sha256(config),
        "sceneslam": sceneslam.__version__,
        "python": platform.python_version(),
        **_dependencies(),
    }


def _dependencies() -> dict[str, str]:
    """Return the versions of the installed packages that SceneSLAM uses."""
    found = {}
    for requirement in requires("sceneslam") or [] if _is_installed() else []:
        name = requirement.split(";")[0].split("[")[0].strip()
        name = name[: next((i for i, c in enumerate(name) if c in "<>=!~ "), len(name))]
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _is_installed() -> bool:
    try:
        version("sceneslam")
    except PackageNotFoundError:
        return False
    return True


def code_sha256() -> str:
    """Return the hash of the package's Python and YAML files, the same in checkout and wheel."""
    digest = hashlib.sha256()
    for package in ("sceneslam", "sceneslam.modules", "sceneslam.conf"):
        root = Path(str(files(package)))
        for file in sorted([*root.rglob("*.py"), *root.rglob("*.yaml")]):
            name = file.relative_to(root)
            if package != "sceneslam" or name.parts[0] not in ("modules", "conf", "experiments"):
                digest.update(f"{package}/{name}".encode() + file.read_bytes())
    return digest.hexdigest()


def input_sha256(config: Mapping[str, Any]) -> str:
    """Return a hash of everything outside of the package that a run reads; "none" for nothing.

    These are the files that `source`, `effects`, `detector` and `slam` name, at any key, and the
    folder of a `path` there; the map `atlas.load`, unless the run saves its own in the same place;
    the code and the programs of `allow_targets`. Of files above 64 MiB, only the first and last
    32 MiB are hashed, to save time.
    """
    digest, is_any = hashlib.sha256(), False
    for piece in _input_pieces(config):
        digest.update(piece)
        is_any = True
    return digest.hexdigest() if is_any else "none"


def files_written(value: Any, key: str = "") -> Iterator[Path]:
    """Yield the files that components of a configuration write beside a run's own."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from files_written(inner, str(name))
    elif isinstance(value, str) and key in _WRITTEN:
        yield given_path(value)


def _input_pieces(config: Mapping[str, Any]) -> Iterator[bytes]:
    """Yield the names, sizes and contents of the files that a run reads."""
    for key in _READERS:
        for path in _named_paths(config.get(key)):
            yield from pieces_of(path)
    atlas = config.get("atlas") or {}
    load = map_folder(atlas, "load")
    if load is not None and load != map_folder(atlas, "save"):
        yield from pieces_of(load)
    for name in config.get("allow_targets") or ():
        for path in _code_paths(str(name)):
            yield from pieces_of(path, _CODE)


def _named_paths(value: Any, key: str = "") -> Iterator[Path]:
    """Yield the files, and the folder of a key `path`, that a part of a configuration names."""
    if isinstance(value, Mapping):
        for name in sorted(set(value) - set(_WRITTEN), key=str):
            yield from _named_paths(value[name], str(name))
    elif isinstance(value, list):
        for item in value:
            yield from _named_paths(item)
    elif isinstance(value, str):
        with suppress(InputError, OSError, ValueError):  # text that no path can be
            path = given_path(value)
            if path.is_file() or (key == "path" and path.is_dir()):
                yield path


def _code_paths(name: str) -> Iterator[Path]:
    """Yield where the code of an allowed name is: its package or module, and its program."""
    package = name.partition(".")[0]
    try:
        spec = find_spec(package) if package.isidentifier() else None  # imports nothing
    except (ImportError, ValueError):
        spec = None
    if spec is not None:
        yield from map(Path, spec.submodule_search_locations or filter(None, [spec.origin]))
    program = shutil.which(name)
    if program is not None:
        yield Path(program)


def pieces_of(root: Path, suffixes: Sequence[str] = ()) -> Iterator[bytes]:
    """Yield names, sizes and contents of a file, or of a folder's files with one of the suffixes.

    Of a file that may not be read, such as some programs, the content is left out.
    """
    for file in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if not file.is_file() or CACHES in file.relative_to(root).parts:
            continue
        if file != root and suffixes and file.suffix not in suffixes:
            continue
        yield f"{file.relative_to(root)} {file.stat().st_size}\n".encode()
        if os.access(file, os.R_OK):
            with file.open("rb") as stream:
                yield stream.read(_EDGE_BYTES)
                stream.seek(max(file.stat().st_size - _EDGE_BYTES, _EDGE_BYTES))
                yield stream.read()


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
