"""The list of all options of all groups, with the first sentence of each file."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from sceneslam.config.files import check_names
from sceneslam.types.errors import ConfigError

GROUPS = {  # group -> description
    "scenario": "A whole set-up: `+scenario=NAME`.",
    "source": "Where observations come from: `source=NAME`.",
    "effects": "How observations are changed: `effects=NAME`.",
    "detector": "How the scene is detected: `detector=NAME`.",
    "slam": "The SLAM modules, each under a key of its own: `slam@slam.KEY=NAME`.",
    "policy": "When the scene and the module change: `policy=NAME`.",
    "atlas": "How maps are fused: `atlas=NAME`.",
    "run": "Mode of a run: `run=NAME`.",
    "evaluation": "Evaluation of a run: `evaluation=NAME`.",
    "sinks": "Outputs: `+sinks@sinks.KEY=NAME`; `~sinks@sinks.rerun` removes one.",
    "viewer": "Live viewers: `viewer=NAME`.",
    "experiment": "Questions that need several runs: `+experiment=NAME`.",
}
_ALIASES = {f"{group}s": group for group in GROUPS} | {"modules": "slam", "module": "slam"}


def listing(words: Sequence[str]) -> list[str]:
    """Return the lines of `python -m sceneslam list [GROUP ...] [--config-dir FOLDER]`.

    Raises ConfigError for an unknown group, a missing folder, or an option in it with the name of
    one of ours.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sceneslam list", description="List what there is to choose."
    )
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=", ".join(GROUPS))
    parser.add_argument("--config-dir", type=Path, help="a folder of your own configurations")
    asked = parser.parse_args(words)
    folders = [Path(str(files("sceneslam.conf")))]
    if asked.config_dir is not None:
        if not asked.config_dir.is_dir():
            raise ConfigError("--config-dir", str(asked.config_dir), "a folder that exists")
        check_names(asked.config_dir)
        folders.append(asked.config_dir)
    lines: list[str] = []
    for name in asked.groups or GROUPS:
        group = _ALIASES.get(name, name)
        if group not in GROUPS:
            raise ConfigError("list", name, ", ".join(GROUPS))
        lines += ["", f"{group}: {GROUPS[group].replace('`', '')}", *_options(group, folders)]
    return lines[1:]


def _options(group: str, folders: Sequence[Path]) -> list[str]:
    """Return a line for each option of a group in any of the folders."""
    files = {
        path.relative_to(folder / group).with_suffix("").as_posix(): path
        for folder in folders
        for path in (folder / group).rglob("*.yaml")
    }
    width = max(map(len, files), default=0)
    return [f"  {name:{width}}  {first_sentence(files[name])}".rstrip() for name in sorted(files)]


def first_sentence(path: Path) -> str:
    """Return the first sentence of the comment at the top of a YAML file; "" without one."""
    said: list[str] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        if line.startswith("# @package"):
            continue
        if not line.startswith("# ") or line.startswith("#  "):  # more text or an example
            break
        said.append(line[2:])
    sentence = re.split(r"(?<!Fig)\. |(?<=\?) ", " ".join(said), maxsplit=1)[0]
    return sentence.rstrip(".:")
