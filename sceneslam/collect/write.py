"""Files of a sweep's table: CSV, Parquet and an HTML page."""

from __future__ import annotations

import csv
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sceneslam.collect.page import write_page
from sceneslam.collect.rows import Row, Value, read_rows, swept_keys
from sceneslam.collect.summary import Group, groups_of
from sceneslam.types.files import replacing

_log = logging.getLogger(__name__)

_REASONS = ("bridged_why.", "missing_why.")  # of poses; a run's metrics hold counts above 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnTable:
    """Columns of equal length."""

    columns: Mapping[str, Sequence[Value]]

    @property
    def rows(self) -> Iterable[Sequence[Value]]:
        """Return the rows."""
        return zip(*self.columns.values(), strict=True)


def collect(folder: Path) -> Path:
    """Make the table of all runs below a folder; return its page. Raises InputError for none."""
    return write_rows(folder, read_rows(folder))


def write_rows(folder: Path, rows: Sequence[Row]) -> Path:
    """Write the tables and the page of some runs; return the page.

    `table` holds deterministic metrics, which are the same for every launcher. Measured times are
    in `costs`.
    """
    rows, keys = _with_zeros(rows), swept_keys(rows)
    _write_csv(folder / "table.csv", _table(rows, keys, metrics=True))
    _write_csv(folder / "costs.csv", _table(rows, keys, metrics=False))
    groups = groups_of(rows)
    _write_csv(folder / "summary.csv", _summary(groups))
    _write_parquet(folder / "table.parquet", _table(rows, keys, metrics=True))
    return write_page(folder, rows, groups)


def _with_zeros(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with 0 for every reason that a run lacks, so that means count it."""
    names = [name for row in rows for name in row.metrics if name.startswith(_REASONS)]
    reasons = dict.fromkeys(names)
    filled = []
    for row in rows:
        is_counted = "bridged" in row.metrics  # by every run with SLAM
        zeros = {name: 0 for name in reasons if is_counted and name not in row.metrics}
        filled.append(replace(row, metrics={**row.metrics, **zeros}))
    return filled


def _table(rows: Sequence[Row], keys: Sequence[str], *, metrics: bool) -> ColumnTable:
    numbers = [row.metrics if metrics else row.costs for row in rows]
    columns: dict[str, Sequence[Value]] = {"job": [row.name for row in rows]}
    columns |= {key: [row.keys.get(key) for row in rows] for key in keys}
    columns |= {"status": [row.status for row in rows], "error": [row.error for row in rows]}
    for name in dict.fromkeys(name for one in numbers for name in one):
        columns[name] = [one.get(name) for one in numbers]
    return ColumnTable(columns=columns)


def _summary(groups: Sequence[Group]) -> ColumnTable:
    """Return one row per setting: number of runs, each metric's mean, 95 % interval and count.

    A run without the metric, such as one that failed, does not count.
    """
    columns: dict[str, Sequence[Value]] = {
        key: [group.keys[key] for group in groups] for key in groups[0].keys
    }
    columns["runs"] = [len(group.rows) for group in groups]
    rows = [row for group in groups for row in group.rows]
    for name in dict.fromkeys(name for row in rows for name in row.metrics):
        means = [group.mean(name) for group in groups]
        columns[name] = [one.mean if one else None for one in means]
        columns[f"{name} ±"] = [one.half_width if one else None for one in means]
        columns[f"{name} runs"] = [one.count if one else 0 for one in means]
    return ColumnTable(columns=columns)


def _write_csv(path: Path, table: ColumnTable) -> None:
    with replacing(path, newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.columns)
        writer.writerows(table.rows)


def _write_parquet(path: Path, table: ColumnTable) -> None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        _log.warning("%s is not written: pip install 'sceneslam[sweep]'", path.name)
        return
    columns = {name: _of_one_type(values) for name, values in table.columns.items()}
    parquet.write_table(pyarrow.table(columns), path)


def _of_one_type(values: Sequence[Value]) -> Sequence[Value]:
    """Return a column for Parquet: text if not all values are numbers."""
    if all(value is None or isinstance(value, int | float) for value in values):
        is_whole = all(value is None or isinstance(value, int) for value in values)
        return values if is_whole else [None if v is None else float(v) for v in values]
    return [None if value is None else str(value) for value in values]
