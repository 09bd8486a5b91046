"""Provenance of a run: configuration, versions, and hashes of code and input."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.resources import files
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

import sceneslam
from sceneslam.types.files import replacing
from sceneslam.types.input_files import given_path

_EDGE_BYTES = 32 << 20  # of the beginning and end of large input files are hashed


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
        "input_sha256": input_sha256(config.get("source") or {}),
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


def input_sha256(source: Mapping[str, Any]) -> str:
    """Return a hash of the input's names, sizes and contents; "none" without a `path`.

    Of files above 64 MiB, only the first and last 32 MiB are hashed, to save time.
    """
    path = str(source.get("path") or "")
    root = given_path(path) if path else None
    if root is None or not root.exists():
        return "none"
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if file.is_file():
            digest.update(f"{file.relative_to(root)} {file.stat().st_size}\n".encode())
            with file.open("rb") as stream:
                digest.update(stream.read(_EDGE_BYTES))
                stream.seek(max(file.stat().st_size - _EDGE_BYTES, _EDGE_BYTES))
                digest.update(stream.read())
    return digest.hexdigest()


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
