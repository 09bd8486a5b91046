"""A folder of rendered stories: whole, checked files only, each made by one process at a time."""

from __future__ import annotations

import ast
import hashlib
import json
import logging
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from sceneslam.types.errors import InputError, told
from sceneslam.types.input_files import given_path

_BLOCK_BYTES = 1 << 22

log = logging.getLogger(__name__)


class Cache:
    """Keeps files under names that hold everything that they depend on."""

    def __init__(self, folder: Path) -> None:
        self._folder = given_path(str(folder))

    def fetch(
        self, name: str, depends_on: Mapping[str, object], make: Callable[[Path], None]
    ) -> Path:
        """Return the file of a configuration; make it when it is missing or damaged.

        `make` writes to the path that it is given; the file counts once that has returned. Other
        processes that want the same file wait for it, those that want another do not. Raises
        InputError where the folder cannot be written, before `make` where that can be known.
        """
        path = self._folder / f"{name}_{fingerprint(depends_on)}.mcap"
        seal = path.with_suffix(".crc32")
        if _is_sealed(path, seal):
            return path
        with _writable(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            with _locked(path.with_suffix(".lock")):
                if not _is_sealed(path, seal):
                    _make(path, seal, make)
        return path


def _make(path: Path, seal: Path, make: Callable[[Path], None]) -> None:
    if path.is_file():
        log.warning("the cached file is damaged and is made anew: %s", path)
    for old in (path, seal):  # a folder in a file's place cannot be replaced
        old.unlink(missing_ok=True)
    part = path.with_suffix(f".{os.getpid()}.part")
    part.touch()
    try:
        make(part)
        seal.write_text(_checksum(part))
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait for a lock file; the lock goes with the process that holds it, however that ends."""
    try:
        import fcntl
    except ImportError:  # Windows: everyone makes its own, and the last one stays
        yield
        return
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.warning("another process makes this recording: waiting for %s", path)
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError:  # a file system without locks: everyone makes its own
            log.info("%s cannot be locked", path)
        yield


@contextmanager
def _writable(cache: Path) -> Iterator[None]:
    """Raise InputError with what to set where a cache cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"source.cache_dir: {cache} cannot be written ({told(error)}); name another folder, as "
            "by SCENESLAM_CACHE_DIR=FOLDER before the command"
        ) from error


def _is_sealed(path: Path, seal: Path) -> bool:
    """Tell whether a file is the one that its checksum was written for."""
    try:
        return seal.read_bytes() == _checksum(path).encode()
    except OSError:
        return False


def fingerprint(depends_on: Mapping[str, object]) -> str:
    """Return twelve digits that change with any value."""
    text = json.dumps(depends_on, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def code_digest(*files: Path) -> str:
    """Return a digest of what Python files do; comments, docstrings and layout are not in it."""
    digest = hashlib.sha256()
    for file in sorted(files):
        tree = ast.parse(file.read_bytes())
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list):
                node.body = [one for one in body if not _is_text(one)]  # type: ignore[attr-defined]
        digest.update(file.name.encode() + ast.dump(tree).encode())
    return digest.hexdigest()


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _checksum(path: Path) -> str:
    """Return size and CRC-32 of a file as text."""
    value = 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            value = zlib.crc32(block, value)
    return f"{path.stat().st_size} {value:08x}"
