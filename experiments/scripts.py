"""What the scripts beside this file share: a run of the program, and settings as shipped."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

CONF = Path(__file__).resolve().parents[1] / "conf"


def run(folder: Path, *overrides: str) -> Path:
    """Run SceneSLAM into a folder, and return that; its own lines go to standard error."""
    command = [sys.executable, "-m", "sceneslam", *overrides, f"hydra.run.dir={folder}"]
    print(" ".join(command[1:]), file=sys.stderr)
    subprocess.run(command, stdout=sys.stderr, check=True)
    return folder


def settings(path: str) -> dict[str, Any]:
    """Return the arguments of a component, by the path of its YAML in `conf`."""
    values: dict[str, Any] = yaml.safe_load((CONF / path).read_text())
    del values["_target_"]
    return values
