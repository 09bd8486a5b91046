"""The main metrics of a table of runs."""

from __future__ import annotations

from collections.abc import Sequence

from sceneslam.collect.rows import Row, swept_keys
from sceneslam.evaluation.verdict import markdown
from sceneslam.types.experiment import Table

FIRST = (
    "ate_rmse_m",
    "ate_max_m",
    "correct_rate",
    "coverage",
    "switches",
    "false_switches",
    "detection.delay_s",
    "detection.false",
    "detection.missed",
)
_ROWS_MAX = 40


def overview(rows: Sequence[Row]) -> str:
    """Return the table of main metrics in Markdown, "" if it is too long."""
    if len(rows) > _ROWS_MAX:
        return ""
    keys = swept_keys(rows)
    metrics = [name for name in FIRST if any(row.metrics.get(name) is not None for row in rows)]
    cells = [
        [row.name, *(row.keys.get(key) for key in keys), row.status]
        + [row.metrics.get(name) for name in metrics]
        for row in rows
    ]
    return markdown(Table(columns=["job", *keys, "status", *metrics], rows=cells))
