"""The proposed table as a scenario that composes like any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path


def write_scenario(
    path: Path, table: Mapping[str, Sequence[str]], *, recordings: Sequence[str]
) -> None:
    """Write scene -> modules, each module under the name of its option."""
    modules = dict.fromkeys(module for choices in table.values() for module in choices)
    lines = [
        "# @package _global_",
        "# Scene -> module, proposed: --config-dir FOLDER/conf +scenario=proposed",
        f"# Seen on: {', '.join(recordings)}",
        "defaults:",
        *(f"  - /slam@slam.{module}: {module}" for module in modules),
        "",
        "scenes:",
        *(f"  {scene}: [{', '.join(choices)}]" for scene, choices in table.items()),
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
