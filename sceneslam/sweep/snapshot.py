"""A copy of the package at the start of a sweep, so that later edits do not affect its jobs."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import mkdtemp

import sceneslam
from sceneslam.config.provenance import code_sha256

_BESIDE = ("conf", "modules", "experiments")  # of a checkout; in a wheel they lie inside


def keep_code(folder: Path) -> Path:
    """Return the folder, below `folder`, of the copied package; copy it if it is missing."""
    target = folder / code_sha256()[:12]
    if target.is_dir():
        return target
    folder.mkdir(parents=True, exist_ok=True)
    part = Path(mkdtemp(dir=folder))
    package, *checkout = [Path(entry) for entry in sceneslam.__path__]
    shutil.copytree(package, part / "sceneslam")
    for root in checkout:
        shutil.copy2(root / "pyproject.toml", part)
        for name in _BESIDE:
            shutil.copytree(root / name, part / name)
    part.rename(target)
    return target
