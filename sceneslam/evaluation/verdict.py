"""An experiment's verdict as files: `verdict.json`, `table.csv`, `table.md`."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

from sceneslam.types.experiment import Figure, Relation, Table, Verdict
from sceneslam.types.files import replacing


def write_verdict(folder: Path, experiment: str, verdict: Verdict) -> None:
    """Write the verdict and its table into a folder."""
    content = {
        "experiment": experiment,
        "holds": verdict.holds,
        "figures": [_plain(figure) for figure in verdict.figures],
    }
    with replacing(folder / "verdict.json") as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")
    with replacing(folder / "table.csv", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([verdict.table.columns, *verdict.table.rows])
    with replacing(folder / "table.md") as file:
        file.write(markdown(verdict.table))


def markdown(table: Table) -> str:
    """Return the table in Markdown, numbers with four digits."""
    rows = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "".join(f"| {' | '.join(map(rounded, row))} |\n" for row in rows)


def verdict_lines(verdict: Verdict) -> list[str]:
    """Return one line per figure, for the command line."""
    return [
        f"{'holds' if figure.holds else 'FAILS'}  {figure.name}: {rounded(figure.value)} "
        f"{figure.unit} ({promised(figure)})"
        for figure in verdict.figures
    ]


def promised(figure: Figure) -> str:
    """Return a figure's bound in words."""
    bound = rounded(figure.bound)
    return {
        Relation.AT_LEAST: f"at least {bound}",
        Relation.AT_MOST: f"at most {bound}",
        Relation.BETWEEN: f"{rounded(figure.low)} to {bound}",
    }[figure.relation]


def _plain(figure: Figure) -> dict[str, str | float | bool | None]:
    low = {"low": figure.low} if figure.relation is Relation.BETWEEN else {}
    return {
        "name": figure.name,
        "value": figure.value if math.isfinite(figure.value) else None,
        "unit": figure.unit,
        "relation": figure.relation.value,
        **low,
        "bound": figure.bound if math.isfinite(figure.bound) else None,
        "holds": figure.holds,
    }


def rounded(value: str | float | None) -> str:
    """Return a cell as a person reads it: a number with four digits, a large one in full."""
    if isinstance(value, str):
        return value
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e15 else f"{value:.4g}"
