"""The runs below a folder, one row each: swept keys, final state and metrics."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from sceneslam.collect.flatten import flat
from sceneslam.collect.status import State, Status
from sceneslam.types.errors import InputError

ROWS = "rows.jsonl"  # rows of settings that were evaluated in one process
Value = str | float | None
# As Hydra reads it; YAML takes 010 for 8, 1:30 for 90 and 1e-3 for text.
_NUMBER = re.compile(
    r"[+-]?(?=\.?\d)(0|[1-9](_?\d)*)?(?P<decimals>\.\d*)?(?P<power>e[+-]?\d+)?", re.IGNORECASE
)
_COSTS = ("_us", "_ms", "realtime_factor", "peak_rss_mb", "wall_s")  # suffixes of metrics


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One run; its metrics are deterministic, its costs depend on the machine."""

    name: str  # its folder, relative to the collected one
    status: str
    error: str = ""
    keys: Mapping[str, Value]  # swept values of the command line
    metrics: Mapping[str, Value] = field(default_factory=dict)
    costs: Mapping[str, Value] = field(default_factory=dict)  # measured times: not reproducible


def read_rows(folder: Path) -> list[Row]:
    """Return a row for every run below a folder, numbered ones in order.

    Raises InputError if no run is found.
    """
    if not folder.is_dir():
        raise InputError(f"expected the folder of a sweep, or of runs: {folder}")
    rows = rows_of(folder, _runs(folder))
    if (folder / ROWS).is_file():
        rows += [Row(**json.loads(line)) for line in (folder / ROWS).read_text().splitlines()]
    if not rows:
        raise InputError(f"no run in the folder: {folder}")
    return rows


def rows_of(folder: Path, runs: Iterable[Path]) -> list[Row]:
    """Return a row for each of the runs below a folder, numbered ones in order."""
    return [_row(folder, run) for run in sorted(runs, key=lambda path: _order(folder, path))]


def swept_keys(rows: Sequence[Row]) -> list[str]:
    """Return the keys whose values differ between rows, in the order given."""
    keys = dict.fromkeys(key for row in rows for key in row.keys)
    return [key for key in keys if len({row.keys.get(key) for row in rows}) > 1]


def _runs(folder: Path) -> Iterator[Path]:
    """Yield the folders of runs; a run inside the folder of another (a reference) is left out."""
    is_run = (folder / "job.json").is_file() or (folder / ".hydra" / "overrides.yaml").is_file()
    if is_run:
        yield folder
        return
    for inner in folder.iterdir():
        if inner.is_dir() and not inner.name.startswith("."):
            yield from _runs(inner)


def _row(root: Path, folder: Path) -> Row:
    status, path = Status.read(folder), folder / "metrics.json"
    if status is None:
        status = _unsupervised(folder)
    costs: dict[str, Value] = {}
    metrics: dict[str, Value] = {}
    if status.is_finished and path.is_file():
        for name, value in flat(_json(path)).items():
            (costs if _is_cost(name) else metrics)[name] = value
    if status.is_finished and (folder / "verdict.json").is_file():
        metrics |= _figures(folder / "verdict.json")
    if status.wall_s is not None:
        costs["job.wall_s"] = status.wall_s
    return Row(
        name=folder.relative_to(root).as_posix(),
        status=status.state.value,
        error=status.error,
        keys=dict(map(parsed, status.overrides)),
        metrics=metrics,
        costs=costs,
    )


def _unsupervised(folder: Path) -> Status:
    """Return the status of a run of Hydra's own launchers, or of a single one, by its results."""
    path, error = folder / "metrics.json", ""
    if path.is_file():
        metrics: Mapping[str, Any] = _json(path)
        error = "; ".join([*metrics.get("errors", ()), *metrics.get("shortfalls", ())])
        state = State.INCOMPLETE if error else State.DONE
    else:
        state = State.DONE if (folder / "verdict.json").is_file() else State.FAILED
    return Status(state=state, error=error, overrides=_overrides(folder))


def _figures(path: Path) -> dict[str, Value]:
    """Return an experiment's figures with bounds, by name."""
    figures = _json(path).get("figures")
    named = figures if isinstance(figures, list) else []
    return {str(figure["name"]): figure["value"] for figure in named}


def _is_cost(name: str) -> bool:
    return any(part.endswith(_COSTS) for part in name.split("."))


def _overrides(folder: Path) -> Sequence[str]:
    path = folder / ".hydra" / "overrides.yaml"
    words = yaml.safe_load(path.read_text()) if path.is_file() else None
    return words if isinstance(words, list) else ()


def parsed(override: str) -> tuple[str, Value]:
    """Return key and value of an override: `+scenario=flicker` sets `scenario`."""
    key, _, text = override.partition("=")
    if key.startswith("~"):
        return key[1:], "(left out)"
    name, number = key.lstrip("+"), _NUMBER.fullmatch(text)
    if number is None:
        return name, text
    return name, float(text) if number["decimals"] or number["power"] else int(text)


def _json(path: Path) -> Mapping[str, object]:
    try:
        values = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"expected JSON ({error}): {path}") from error
    if not isinstance(values, dict):
        raise InputError(f"expected a table of metrics, got {type(values).__name__}: {path}")
    return values


def _order(root: Path, folder: Path) -> list[tuple[int, str]]:
    """Sort numbered folders by number, others by name."""
    parts = folder.relative_to(root).parts
    return [(int(part), "") if part.isdecimal() else (sys.maxsize, part) for part in parts]
