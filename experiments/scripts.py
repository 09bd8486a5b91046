"""What the scripts beside this file share: runs, recordings, and settings as shipped."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from sceneslam.config.build import make_source
from sceneslam.config.component import ComponentBuilder
from sceneslam.interfaces import Source
from sceneslam.script import composed
from sceneslam.types.observation import Observation

CONF = Path(__file__).resolve().parents[1] / "conf"


def run(folder: Path, *overrides: str) -> Path:
    """Run SceneSLAM into a folder, and return that; its own lines go to standard error.

    Where it fails, its last line says why, and the script ends with its exit code.
    """
    command = [sys.executable, "-m", "sceneslam", *overrides, f"hydra.run.dir={folder}"]
    print(" ".join(command[1:]), file=sys.stderr)
    if code := subprocess.run(command, stdout=sys.stderr).returncode:
        sys.exit(code)
    return folder


def settings(path: str) -> dict[str, Any]:
    """Return the arguments of a component, by the path of its YAML in `conf`."""
    values: dict[str, Any] = yaml.safe_load((CONF / path).read_text())
    del values["_target_"]
    return values


def single(module: str, *overrides: str) -> tuple[Source, ComponentBuilder]:
    """Return a run's source, and what builds its one module, which is `slam.only`."""
    config = composed(("+scenario=single", f"slam@slam.only={module}", *overrides), None)
    builder = ComponentBuilder(config)
    return make_source(config, builder), builder


def backwards(observations: Sequence[Observation]) -> list[Observation]:
    """Return the observations from the end, with rising stamps; motions in them are not turned."""
    ends_ns = observations[0].stamp_ns + observations[-1].stamp_ns
    turned = []
    for one in reversed(observations):
        scan = one.scan and replace(one.scan, stamp_ns=ends_ns - one.scan.stamp_ns)
        turned.append(replace(one, stamp_ns=ends_ns - one.stamp_ns, scan=scan))
    return turned
