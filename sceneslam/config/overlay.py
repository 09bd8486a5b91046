"""Texts on a run: the comment of its experiment's YAML file, and its command line."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import cast

from hydra.conf import HydraConf
from omegaconf import DictConfig, ListConfig, OmegaConf

_COMMAND_LINE = "command-line"  # Hydra's name for the provider of --config-dir


def comment_of(hydra: HydraConf | DictConfig, group: str) -> list[str]:
    """Return the first comment of a group's chosen YAML file, as paragraphs.

    Indented lines of such a comment are commands, and end a paragraph.
    """
    choice = hydra.runtime.choices.get(group)
    for source in hydra.runtime.config_sources:
        path = _folder(source.schema, source.path)
        if choice and path is not None and (found := path / group / f"{choice}.yaml").is_file():
            return _paragraphs(found.read_text("utf-8"))
    return []


def command_of(hydra: HydraConf | DictConfig) -> str:
    """Return the command line that repeats the run."""
    own, given = typed_words(hydra.overrides.task), typed_words(hydra.overrides.hydra)
    folders = [s.path for s in hydra.runtime.config_sources if s.provider == _COMMAND_LINE]
    words = [word for word in given if not word.startswith("hydra.mode=")]
    beside = [word for folder in folders for word in ("--config-dir", folder)]
    return shlex.join(["python", "-m", "sceneslam", *beside, *own, *words])


def typed_words(overrides: Sequence[str]) -> list[str]:
    """Return Hydra's record of overrides as they were typed, with unresolved `${...}`."""
    return cast("list[str]", OmegaConf.to_container(cast(ListConfig, overrides), resolve=False))


def _folder(schema: str, path: str) -> Traversable | None:
    if schema == "pkg":
        return files(path.replace("/", "."))
    return Path(path) if schema == "file" else None


def _paragraphs(text: str) -> list[str]:
    paragraphs = [""]
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        said = line.removeprefix("#").removeprefix(" ")
        if said.startswith("  "):
            paragraphs.append("")
        elif not said.startswith("@package"):
            paragraphs[-1] = f"{paragraphs[-1]} {said}".strip()
    return [f"{one.removesuffix(':')}." if one.endswith(":") else one for one in paragraphs if one]
