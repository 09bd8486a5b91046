"""A folder of rendered stories: whole, checked files only."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from sceneslam.sources.cache_folder import writable
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

        `make` writes to the path that it is given; the file counts once that has returned. Raises
        InputError where the folder cannot be written, before `make` where that can be known.
        """
        path = self._folder / f"{name}_{fingerprint(depends_on)}.mcap"
        seal = path.with_suffix(".crc32")
        if path.is_file():
            if _is_sealed(path, seal):
                return path
            log.warning("the cached file is damaged and is made anew: %s", path)
        part = path.with_suffix(f".{os.getpid()}.part")
        with writable(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            for old in (path, seal):  # a folder in a file's place cannot be replaced
                old.unlink(missing_ok=True)
            part.touch()
            try:
                make(part)
                seal.write_text(_checksum(part))
                part.replace(path)
            finally:
                with suppress(OSError):
                    part.unlink(missing_ok=True)
        return path


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
    """Return a digest of the text of source files."""
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _checksum(path: Path) -> str:
    """Return size and CRC-32 of a file as text."""
    value = 0
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            value = zlib.crc32(block, value)
    return f"{path.stat().st_size} {value:08x}"
