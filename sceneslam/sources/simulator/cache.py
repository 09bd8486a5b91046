"""A cache folder of rendered stories: complete files with checksums, each made by one process."""

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

from sceneslam.types.errors import InputError, text_of
from sceneslam.types.input_files import given_path

_BLOCK_BYTES = 1 << 22

log = logging.getLogger(__name__)


class Cache:
    """Keeps files under names with a hash of everything that they depend on."""

    def __init__(self, folder: Path) -> None:
        self._folder = given_path(str(folder))

    def fetch(
        self, name: str, depends_on: Mapping[str, object], make: Callable[[Path], None]
    ) -> Path:
        """Return the path of a cached file; make it if it is missing or damaged.

        `make` writes to the given path; the file is valid once `make` has returned. Other processes
        wait only if they need the same file. Raises InputError if the folder cannot be written, if
        possible before `make` is called.
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
        log.warning("the cached file is damaged and is rendered again: %s", path)
    for old in (path, seal):  # a folder at the file's path cannot be replaced
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
    """Hold a file lock; it is released when its process ends in any way."""
    try:
        import fcntl
    except ImportError:  # Windows: each process makes the file, the last one stays
        yield
        return
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.warning("another process makes this recording: waiting for %s", path)
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError:  # a file system without locks: each process makes the file
            log.info("%s cannot be locked", path)
        yield


@contextmanager
def _writable(cache: Path) -> Iterator[None]:
    """Raise InputError, with the variable to set, if the cache cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"source.cache_dir: {cache} cannot be written ({text_of(error)}); name another folder, "
            "as by SCENESLAM_CACHE_DIR=FOLDER before the command"
        ) from error


def _is_sealed(path: Path, seal: Path) -> bool:
    """Tell whether a file agrees with its stored checksum."""
    try:
        return seal.read_bytes() == _checksum(path).encode()
    except OSError:
        return False


def fingerprint(depends_on: Mapping[str, object]) -> str:
    """Return a hash of twelve digits of the values."""
    text = json.dumps(depends_on, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def code_digest(*files: Path) -> str:
    """Return a hash of the code of Python files, without comments, docstrings and layout."""
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
    """Return the size and CRC-32 of a file as text."""
    value = 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            value = zlib.crc32(block, value)
    return f"{path.stat().st_size} {value:08x}"
