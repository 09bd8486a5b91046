"""The comparison of runs as an HTML page, and as lines for the terminal."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from sceneslam.compare import figures
from sceneslam.compare.runs import Run, differing
from sceneslam.evaluation.comparison import compare
from sceneslam.evaluation.report import markup
from sceneslam.evaluation.report.page import fill_page
from sceneslam.evaluation.report.summary import degrees, number, percent
from sceneslam.types.errors import InputError

_SHOWN_SETTINGS = 40
_Measure = tuple[str, Callable[[Any], str]]
_MEASURES: Sequence[_Measure] = (  # the measures of each run
    ("position error (ATE RMSE)", lambda m: number(m["ate_rmse_m"], 4, " m")),
    ("largest position error", lambda m: number(m["ate_max_m"], 3, " m")),
    ("rotation error (RMSE)", lambda m: degrees(m["ate_rot_rad"])),
    ("of the time correct", lambda m: percent(m["correct_rate"])),
    ("observations with a pose", lambda m: percent(m["coverage"])),
    ("distance travelled, estimated", lambda m: number(m["path_length_m"], 2, " m")),
    ("changes of module", lambda m: str(len(m["switches"]))),
    ("false switches", lambda m: number(m["false_switches"], 0)),
    ("speed, times real time", lambda m: number(m["realtime_factor"], 2, " ×")),
    ("peak memory", lambda m: number(m["peak_rss_mb"], 0, " MB")),
    ("faults", lambda m: str(len({*m.get("errors", ()), *m["shortfalls"]}) or "none")),
)


def measured(runs: Sequence[Run]) -> list[list[str]]:
    """Return a row per measure: its name, then a value per run."""
    rows = [[name, *(tell(run.metrics) for run in runs)] for name, tell in _MEASURES]
    apart = [
        compare(run.trajectory, runs[0].trajectory, run.metrics["association_gap_s"])
        for run in runs[1:]
    ]
    if any(len(one.stamps_ns) for one in apart):
        name = f"largest distance from {runs[0].name}"
        far = [number(one.max_m if len(one.stamps_ns) else None, 3, " m") for one in apart]
        rows.append([name, "–", *far])
    return [row for row in rows if any(cell != "–" for cell in row[1:])]


def lines(runs: Sequence[Run]) -> list[str]:
    """Return the measures as a table for the terminal."""
    rows = [["", *(run.name for run in runs)], *measured(runs)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
        for row in rows
    ]


def write_page(folder: Path, runs: Sequence[Run]) -> Path:
    """Write `report.html` and its figures to a folder; return the page's path.

    Raises InputError where the folder cannot be written.
    """
    try:
        return _write(folder, runs)
    except OSError as error:
        raise InputError(f"the page cannot be written ({error.strerror}): {folder}") from error


def _write(folder: Path, runs: Sequence[Run]) -> Path:
    pictures = []
    if figures.paths(folder / "paths.png", runs):
        pictures.append(("paths.png", "All paths from above, in the frame map of the first run."))
    if figures.errors(folder / "errors.png", runs):
        aligned = "Position error over time, each trajectory aligned to the truth as a whole."
        pictures.append(("errors.png", aligned))
    settings = differing(runs)
    shown = [[row.key, *row.values] for row in settings[:_SHOWN_SETTINGS]]
    left = len(settings) - len(shown)
    heads = [run.name for run in runs]
    values = {
        "title": escape(" · ".join(heads)),
        "measured": markup.table(["", *_links(folder, runs)], measured(runs)),
        "figures": "".join(
            markup.picture((folder / name).read_bytes(), caption) for name, caption in pictures
        ),
        "settings": markup.table(["key", *heads], shown)
        if settings
        else '<p class="muted">None: the configurations are the same.</p>',
        "more": f'<p class="muted">And {left} more keys.</p>' if left else "",
    }
    return fill_page(folder / "report.html", "sceneslam.compare", "page.html", values)


def _links(folder: Path, runs: Sequence[Run]) -> list[str]:
    """Return each run's name, with a link to its report if there is one."""
    return [
        markup.link(os.path.relpath(run.folder / "report.html", folder), run.name)
        if (run.folder / "report.html").is_file()
        else run.name
        for run in runs
    ]
