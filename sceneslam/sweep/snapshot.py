"""A copy of the package at the start of a sweep, so that later edits do not affect its jobs."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from tempfile import mkdtemp

import sceneslam
from sceneslam.config.provenance import CACHES, pieces_of

_BESIDE = ("conf", "modules", "experiments")  # of a checkout; in a wheel they lie inside


def keep_code(folder: Path) -> Path:
    """Return the folder, below `folder`, of the copied package; copy it if it is missing."""
    parts = _parts()
    target = folder / _sha256(parts)[:12]
    if target.is_dir():
        return target
    folder.mkdir(parents=True, exist_ok=True)
    part = Path(mkdtemp(dir=folder))
    for name, path in parts.items():
        if path.is_dir():
            shutil.copytree(path, part / name, ignore=shutil.ignore_patterns(CACHES))
        else:
            shutil.copy2(path, part / name)
    part.rename(target)
    return target


def _parts() -> Mapping[str, Path]:
    """Return what is copied: the name in the copy, and the file or folder."""
    package, *checkout = [Path(entry) for entry in sceneslam.__path__]
    beside = {name: root / name for root in checkout for name in ("pyproject.toml", *_BESIDE)}
    return {"sceneslam": package, **beside}


def _sha256(parts: Mapping[str, Path]) -> str:
    """Return a hash of the names and contents of all that is copied."""
    digest = hashlib.sha256()
    for name, path in parts.items():
        digest.update(f"{name}\n".encode())
        for piece in pieces_of(path):
            digest.update(piece)
    return digest.hexdigest()
