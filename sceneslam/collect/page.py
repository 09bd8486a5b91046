"""The table of a sweep as one self-contained HTML file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path

from sceneslam.collect.curves import charts
from sceneslam.collect.overview import FIRST
from sceneslam.collect.rows import Row, Value, swept_keys
from sceneslam.collect.summary import Group, Mean
from sceneslam.evaluation.report.markup import bullets, link, tiles
from sceneslam.evaluation.report.page import fill_page

_ROWS_MAX = 2000
_ERRORS_MAX = 20


def write_page(folder: Path, rows: Sequence[Row], groups: Sequence[Group]) -> Path:
    """Write `index.html`; return its path."""
    counts = {"runs": len(rows), **Counter(row.status for row in rows)}
    values = {
        "title": escape("/".join(folder.resolve().parts[-2:])),  # Hydra's are DATE/TIME
        "numbers": tiles({name: str(count) for name, count in counts.items()}),
        "errors": _errors(rows),
        "charts": "".join(charts(groups)),
        "summary": _summary(groups),
        "table": _table(folder, rows),
    }
    return fill_page(folder / "index.html", "sceneslam.collect", "page.html", values)


def _errors(rows: Sequence[Row]) -> str:
    wrong = [row for row in rows if row.error]
    if not wrong:
        return ""
    errors = bullets(f"{row.name}: {row.error}" for row in wrong[:_ERRORS_MAX])
    more = f"<p>and {len(wrong) - _ERRORS_MAX} more</p>" if len(wrong) > _ERRORS_MAX else ""
    return f'<h2>What went wrong</h2><div class="faults">{errors}{more}</div>'


def _summary(groups: Sequence[Group]) -> str:
    if all(len(group.rows) == 1 for group in groups):
        return ""
    metrics = [name for name in FIRST if any(group.mean(name) for group in groups)]
    body = [
        [
            *(_cell(value) for value in group.keys.values()),
            _cell(len(group.rows)),
            *(_mean_cell(group.mean(name), len(group.rows)) for name in metrics),
        ]
        for group in groups
    ]
    heads = [*((key, False) for key in (*groups[0].keys, "runs", *metrics))]
    return (
        "<h2>Means over seeds</h2><p class=muted>With 95 % confidence intervals (Student's t). "
        "Where fewer runs have a number, it is the mean over those.</p>" + _html_table(heads, body)
    )


def _table(folder: Path, rows: Sequence[Row]) -> str:
    """Return the table of all runs; metrics other than the main ones are hidden at first."""
    keys = swept_keys(rows)
    shown = rows[:_ROWS_MAX]
    metrics = list(dict.fromkeys(name for row in rows for name in row.metrics))
    costs = list(dict.fromkeys(name for row in rows for name in row.costs))
    first = [name for name in FIRST if name in metrics]
    rest = [name for name in (*metrics, *costs) if name not in first]
    heads = [(name, False) for name in ("job", *keys, "status", *first)]
    heads += [(name, True) for name in rest]
    body = [
        [
            _link(folder, row),
            *(_cell(row.keys.get(key)) for key in keys),
            _cell(row.status),
            *(_cell(row.metrics.get(name)) for name in first),
            *(_cell(row.metrics.get(name, row.costs.get(name)), more=True) for name in rest),
        ]
        for row in shown
    ]
    left = len(rows) - len(shown)
    note = f'<p class="muted">{left} more are in table.csv.</p>' if left else ""
    return _html_table(heads, body) + note


def _html_table(heads: Sequence[tuple[str, bool]], body: Sequence[Sequence[str]]) -> str:
    head = "".join(
        f'<th{" class=more" if more else ""}><button type="button">{escape(name)}</button></th>'
        for name, more in heads
    )
    lines = "\n".join(f"<tr>{''.join(row)}</tr>" for row in body)
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{lines}</tbody></table></div>"
    )


def _link(folder: Path, row: Row) -> str:
    if not (folder / row.name / "report.html").is_file():
        return _cell(row.name)
    return f"<td>{link(f'{row.name}/report.html', row.name)}</td>"


def _cell(value: Value, *, more: bool = False) -> str:
    hidden = " class=more" if more else ""
    if value is None:
        return f"<td{hidden}></td>"
    if isinstance(value, str):
        return f"<td{hidden}>{escape(value)}</td>"
    return f'<td{hidden} data-v="{value!r}">{_rounded(value)}</td>'


def _mean_cell(mean: Mean | None, runs: int) -> str:
    if mean is None:
        return "<td></td>"
    width = "" if mean.half_width is None else f" ± {mean.half_width:.2g}"
    fewer = "" if mean.count == runs else f" ({mean.count} of {runs})"
    return f'<td data-v="{mean.mean!r}">{_rounded(mean.mean)}{width}{fewer}</td>'


def _rounded(value: float) -> str:
    return f"{value:.6g}" if isinstance(value, int) or value == round(value) else f"{value:.4g}"
