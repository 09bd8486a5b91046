"""An experiment as a self-contained HTML file: question, bounds, results and runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from sceneslam.evaluation.report import markup
from sceneslam.evaluation.report.page import fill_page
from sceneslam.evaluation.report.summary import number, percent
from sceneslam.evaluation.verdict import promised, rounded
from sceneslam.types.experiment import Figure, Trial, Verdict

_OPEN_RUNS = 12  # a longer list is folded


@dataclass(frozen=True, slots=True, kw_only=True)
class Asked:
    """What an experiment was called for, and how."""

    name: str
    question: Sequence[str]  # paragraphs
    command: str
    config_yaml: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ran:
    """A trial that was run, or found finished."""

    trial: Trial
    folder: Path
    metrics: Mapping[str, Any]
    faults: Sequence[str]


def write_verdict_page(folder: Path, asked: Asked, verdict: Verdict, runs: Sequence[Ran]) -> Path:
    """Write `report.html` into the experiment's folder; return its path."""
    values = {
        "title": escape(asked.name),
        "question": markup.paragraphs(asked.question),
        "kept": escape(_kept(verdict.figures)),
        "promises": _promises(verdict.figures),
        "pictures": "".join(
            markup.picture((folder / name).read_bytes(), caption)
            for name, caption in verdict.pictures.items()
            if (folder / name).is_file()
        ),
        "table": markup.table(
            verdict.table.columns, [[rounded(cell) for cell in row] for row in verdict.table.rows]
        ),
        "runs": _runs(folder, runs),
        "command": escape(asked.command),
        "config": escape(asked.config_yaml),
    }
    return fill_page(
        folder / "report.html", "sceneslam.evaluation.report", "verdict_page.html", values
    )


def _kept(figures: Sequence[Figure]) -> str:
    held = sum(figure.holds for figure in figures)
    if not figures:
        return "No bounds are set"
    return f"{held} of {len(figures)} bounds hold"


def _promises(figures: Sequence[Figure]) -> str:
    items = "".join(
        f'<li class="{"holds" if figure.holds else "fails"}">'
        f"<b>{'holds' if figure.holds else 'FAILS'}</b><div>{escape(figure.name)}</div>"
        f"<span>{escape(_measured(figure))}</span></li>"
        for figure in sorted(figures, key=lambda figure: figure.holds)
    )
    return f'<ul class="promises">{items}</ul>'


def _measured(figure: Figure) -> str:
    return f"{rounded(figure.value)} {figure.unit}".rstrip() + f" ({promised(figure)})"


def _runs(folder: Path, runs: Sequence[Ran]) -> str:
    if not runs:
        return '<p class="muted">None: this experiment needs no run of the robot.</p>'
    heads = ["run", "poses", "error (ATE)", "faults", "given besides the command"]
    rows = [
        [
            _link(folder, run),
            percent(run.metrics.get("coverage")),
            number(run.metrics.get("ate_rmse_m"), 4, " m"),
            _amiss(run),
            " ".join([*run.trial.overrides, *(f"{k}={v}" for k, v in run.trial.values.items())]),
        ]
        for run in runs
    ]
    is_open = " open" if len(runs) <= _OPEN_RUNS else ""
    summary = f"<summary>{len(runs)} runs</summary>"
    return f"<details{is_open}>{summary}{markup.table(heads, rows)}</details>"


def _amiss(run: Ran) -> str:
    """Return the number of a trial's faults and shortfalls, and the first of them."""
    sentences = list(dict.fromkeys([*run.faults, *run.metrics.get("shortfalls", ())]))
    if len(sentences) < 2:
        return "".join(sentences)
    return f"{len(sentences)}, first: {sentences[0]}"


def _link(folder: Path, run: Ran) -> str:
    report = run.folder / "report.html"
    if not report.is_file():
        return run.trial.name
    return markup.link(report.relative_to(folder).as_posix(), run.trial.name)
