"""The experiment `handover`: what is lost between two modules, by kind of hand-over.

`conf/experiment/handover.yaml` says how it is called, `experiments/handover.md` what was found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from sceneslam.experiments.handover.figure import draw_seams
from sceneslam.experiments.handover.seam import Seam, measure
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, Relation, RunTrials, Table, Trial, Verdict
from sceneslam.types.ranges import check_above, check_among, check_least, check_some
from sceneslam.types.run import HANDOVERS

_PERIOD_S = 1.0  # of slack, so that the run does not end at the very pose that is measured


class HandoverExperiment:
    """Measures the error of the motion across a hand-over, and the time without a pose."""

    def __init__(
        self,
        *,
        kinds: Sequence[str],
        startups_s: Sequence[float],
        lost_s: Sequence[float],
        confirmed_s: float,
        after_s: float,
        window_s: float,
        rate_hz: float,
        seam_limit_m: float,
    ) -> None:
        check_some(kinds=kinds, startups_s=startups_s, lost_s=lost_s)
        check_among(HANDOVERS, kinds=kinds)
        check_least(0, startups_s=startups_s, lost_s=lost_s, after_s=after_s)
        check_above(0, window_s=window_s, rate_hz=rate_hz, seam_limit_m=seam_limit_m)
        if not window_s < confirmed_s:
            raise ConfigError("confirmed_s", confirmed_s, f"more than the window of {window_s} s")
        if max(lost_s, default=0.0) > window_s:
            raise ConfigError("lost_s", list(lost_s), f"at most the window of {window_s} s")
        self._cells = list(product(kinds, startups_s, lost_s))
        self._confirmed_s, self._window_s, self._after_s = confirmed_s, window_s, after_s
        self._rate_hz, self._seam_limit_m = rate_hz, seam_limit_m

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run every cell; return the seams and whether `rewind` keeps its promise."""
        outcomes = run_trials([self._trial(*cell) for cell in self._cells])
        changed_s = self._confirmed_s - self._window_s
        seams = [
            measure(outcome, *cell, since_s=changed_s, after_s=self._after_s)
            for cell, outcome in zip(self._cells, outcomes, strict=True)
        ]
        draw_seams(folder / "seams.png", seams)
        return Verdict(
            figures=list(self._figures(seams)),
            table=_table(seams),
            pictures={"seams.png": "What each kind of hand-over loses beyond the module's drift."},
        )

    def _trial(self, kind: str, startup_s: float, lost_s: float) -> Trial:
        changed_s = self._confirmed_s - self._window_s
        ends_s = self._confirmed_s + startup_s + self._after_s + _PERIOD_S
        return Trial(
            name=f"{kind}/start_{startup_s:g}s_lost_{lost_s:g}s",
            values={
                "policy": {"handover": kind, "startup_s": {"dark": startup_s}},
                "detector": {"schedule": [[0.0, "Bright"], [changed_s, "Dark"]]},
                "effects": {"schedule": [[self._confirmed_s - lost_s, 0.0]]},
                "run": {"max_observations": round(ends_s * self._rate_hz)},
            },
        )

    def _figures(self, seams: Sequence[Seam]) -> Iterator[Figure]:
        for seam in (one for one in seams if one.kind == "rewind"):
            name = f"rewind, start {seam.startup_s:g} s, lost {seam.lost_s:g} s before"
            yield Figure(
                name=f"{name}: seam beyond the new module's drift",
                value=seam.beyond_m,
                relation=Relation.AT_MOST,
                bound=self._seam_limit_m,
                unit="m",
            )
            yield Figure(
                name=f"{name}: gap",
                value=seam.gap_s,
                relation=Relation.AT_MOST,
                bound=0.0,
                unit="s",
            )


def _table(seams: Sequence[Seam]) -> Table:
    columns = ("hand-over", "start [s]", "lost before [s]", "motion error [cm]")
    rows = [
        (
            one.kind,
            one.startup_s,
            one.lost_s,
            100 * one.error_m,
            100 * one.drift_m,
            100 * one.beyond_m,
            one.gap_s,
            100 * one.online_m,
        )
        for one in seams
    ]
    more = ("own drift [cm]", "beyond it [cm]", "gap [s]", "online [cm]")
    return Table(columns=(*columns, *more), rows=rows)
