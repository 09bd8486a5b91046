"""The experiment `programs`: a program that does wrong is stopped, and nothing else is harmed.

`conf/experiment/programs.yaml` says how it is called, `experiments/programs/README.md` what was
found.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from sceneslam.supervision.limits import Limits
from sceneslam.types.experiment import Figure, RunTrials, Table, Verdict
from sceneslam.types.ranges import check_above, check_least

from .case import Case, run_case
from .hostile import KINDS


class ProgramsExperiment:
    """Runs hostile programs, one per seed, as SLAM modules."""

    def __init__(self, *, cases: int, seed: int, late_max_s: float, limits: Limits) -> None:
        check_least(1, cases=cases)
        check_least(0, seed=seed)
        check_above(0, late_max_s=late_max_s)
        self._cases, self._seed, self._late_max_s, self._limits = cases, seed, late_max_s, limits

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run them without a recording; return how many were stopped as they have to be."""
        seeds = range(self._seed, self._seed + self._cases)
        cases = [run_case(seed, self._limits) for seed in seeds]
        lines = "".join(f"{json.dumps(asdict(case))}\n" for case in cases)
        (folder / "cases.jsonl").write_text(lines)
        return Verdict(figures=self._figures(cases), table=_table(cases))

    def _figures(self, cases: Sequence[Case]) -> list[Figure]:
        unstopped = sum(not case.sentence for case in cases)
        wordy = sum(len(case.sentence.splitlines()) > 1 for case in cases)
        return [
            Figure.at_least("kinds of wrong", len({case.kind for case in cases}), len(KINDS)),
            Figure.at_most("not stopped", unstopped, 0),
            Figure.at_most("stopped with more than a sentence", wordy, 0),
            Figure.at_most(
                "longest after the deadline",
                max(case.late_s for case in cases),
                self._late_max_s,
                "s",
            ),
            Figure.at_most("that harmed anything else", sum(bool(c.harm) for c in cases), 0),
        ]


def _table(cases: Sequence[Case]) -> Table:
    """Return a row per kind, with one of its sentences."""
    rows: list[list[str | float | None]] = []
    for kind in KINDS:
        of_kind = [case for case in cases if case.kind == kind]
        if of_kind:
            stopped = float(sum(bool(case.sentence) for case in of_kind))
            latest_s = max(case.late_s for case in of_kind)
            said = of_kind[-1].sentence[:160]
            rows.append([kind, float(len(of_kind)), stopped, latest_s, said])
    columns = ["what it does", "cases", "stopped", "after the deadline [s]", "for example"]
    return Table(columns=columns, rows=rows)
