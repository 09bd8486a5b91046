"""Reading of finished runs from their folders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sceneslam.types.errors import InputError
from sceneslam.types.trajectory import Trajectory

_UNSET = "–"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """A finished run."""

    name: str  # unique among the runs
    folder: Path
    metrics: Mapping[str, Any]
    trajectory: Trajectory  # T_map_base
    truth: Trajectory | None
    settings: Mapping[str, str]  # dotted key -> value, of the resolved configuration


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """A key with different values in the runs."""

    key: str
    values: Sequence[str]  # one per run


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Return the runs of folders; raises InputError if one holds no finished run."""
    names = _names(folders)
    return [_read(folder, name) for folder, name in zip(folders, names, strict=True)]


def differing(runs: Sequence[Run]) -> list[Setting]:
    """Return the settings in which the runs differ, in the order of the configuration."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    rows = [
        Setting(key=key, values=[run.settings.get(key, _UNSET) for run in runs]) for key in keys
    ]
    return [row for row in rows if len(set(row.values)) > 1]


def _names(folders: Sequence[Path]) -> list[str]:
    """Return unique names: the last parts of each path, as many as needed."""
    parts = [folder.resolve().parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    raise InputError(f"the same run twice: {next(f for f in folders if folders.count(f) > 1)}")


def _read(folder: Path, name: str) -> Run:
    for needed in ("metrics.json", "trajectory.tum", "config.yaml"):
        if not (folder / needed).is_file():
            advice = " (python -m sceneslam.recover makes the results of a run that was cut off)"
            hint = advice if (folder / "journal.bin").is_file() else ""
            raise InputError(f"not the folder of a finished run, no {needed}: {folder}{hint}")
    try:
        metrics = json.loads((folder / "metrics.json").read_text("utf-8"))
        config = yaml.safe_load((folder / "config.yaml").read_text("utf-8"))
    except (ValueError, yaml.YAMLError) as error:
        raise InputError(f"damaged metrics.json or config.yaml: {folder}") from error
    if not isinstance(metrics, Mapping) or not isinstance(config or {}, Mapping):
        raise InputError(f"metrics.json or config.yaml is not a table: {folder}")
    if "association_gap_s" not in metrics:
        raise InputError(f"metrics.json is not that of a run, no association_gap_s: {folder}")
    truth = folder / "groundtruth.tum"
    return Run(
        name=name,
        folder=folder,
        metrics=metrics,
        trajectory=Trajectory.read_tum(folder / "trajectory.tum"),
        truth=Trajectory.read_tum(truth) if truth.is_file() else None,
        settings=dict(_flat(config or {})),
    )


def _flat(config: Mapping[str, Any], above: str = "") -> list[tuple[str, str]]:
    """Return every value of nested tables with its dotted key."""
    found: list[tuple[str, str]] = []
    for key, value in config.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and value:
            found += _flat(value, f"{name}.")
        else:
            found.append((name, json.dumps(value, default=str).strip('"')))
    return found
