"""The experiment `table`: every module over recordings, and the table scene -> module it makes.

`conf/experiment/table.yaml` says how it is called, `experiments/table/README.md` what was found.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

import numpy as np

from sceneslam.experiments.table.evidence import Evidence, propose, weigh
from sceneslam.experiments.table.figure import draw_scores
from sceneslam.experiments.table.overlay import write_scenario
from sceneslam.experiments.table.stretch import Motions, measure
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_between, check_some


class TableExperiment:
    """Runs every module alone; the detector of the configuration says what a scene is.

    `recordings`: name -> the overrides that select it; `modules`: options of `slam`. A module
    whose sensors a recording does not have is left out there.
    """

    def __init__(
        self,
        *,
        recordings: Mapping[str, Sequence[str]],
        modules: Sequence[str],
        interval_s: float,
        lost_m: float,
        fallback_min: float,
        available_min: float,
    ) -> None:
        check_some(recordings=recordings, modules=modules)
        check_above(0, interval_s=interval_s, lost_m=lost_m)
        check_between(0, 1, fallback_min=fallback_min, available_min=available_min)
        self._recordings, self._modules = recordings, modules
        self._interval_s, self._lost_m = interval_s, lost_m
        self._fallback_min, self._available_min = fallback_min, available_min

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return the evidence; the proposed table becomes a scenario of its own."""
        evidence = [one for module in self._modules for one in self._weigh(run_trials, module)]
        evidence.sort(key=lambda one: (one.scene, one.score_m))
        table = propose(evidence, fallback_min=self._fallback_min)
        draw_scores(folder / "scores.png", evidence, interval_s=self._interval_s)
        path = folder / "conf" / "scenario" / "proposed.yaml"
        write_scenario(path, table, recordings=list(self._recordings))
        first = [one for one in evidence if table[one.scene][:1] == [one.module]]
        figures = [
            Figure.at_least(
                f"{one.scene}: {one.module} gives a pose", one.available, self._available_min
            )
            for one in first
        ]
        scores = {"scores.png": "The score of every module, scene by scene: less is better."}
        return Verdict(figures=figures, table=_table(evidence, table), pictures=scores)

    def _weigh(self, run_trials: RunTrials, module: str) -> Sequence[Evidence]:
        """Return what a module did in every scene that it was shown."""
        motions: dict[str, list[Motions]] = defaultdict(list)
        shown: dict[str, set[str]] = defaultdict(set)
        costs_ms = []
        for name, outcome in self._outcomes(run_trials, module):
            for one in measure(outcome, self._interval_s):
                motions[one.scene].append(one)
                shown[one.scene].add(name)
            cost_ms = outcome.metrics["modules"].get("only", {}).get("frame_ms", {}).get("median")
            costs_ms += [] if cost_ms is None else [cost_ms]
        return [
            weigh(
                module,
                scene,
                found,
                recordings=len(shown[scene]),
                lost_m=self._lost_m,
                frame_ms=median(costs_ms) if costs_ms else float("nan"),
            )
            for scene, found in motions.items()
        ]

    def _outcomes(self, run_trials: RunTrials, module: str) -> Iterator[tuple[str, TrialResult]]:
        """Yield what the module did on each recording that has its sensors."""
        left = {
            name: Trial(name=f"{name}/{module}", overrides=(*words, f"slam@slam.only={module}"))
            for name, words in self._recordings.items()
        }
        while left:
            try:
                for outcome in run_trials(list(left.values())):
                    name = next(iter(left))
                    del left[name]
                    yield name, outcome
            except ConfigError as error:
                if error.key != "slam.only":
                    raise
                del left[next(iter(left))]  # not its sensors


def _table(evidence: Sequence[Evidence], table: Mapping[str, Sequence[str]]) -> Table:
    columns = ("scene", "module", "place", "score [cm]", "error [cm]", "error [deg]")
    rows = [
        (
            one.scene,
            one.module,
            _place(one, table),
            100 * one.score_m,
            100 * one.error_m,
            float(np.rad2deg(one.error_rad)),
            100 * one.available,
            one.frame_ms,
            float(one.recordings),
        )
        for one in evidence
    ]
    more = ("available [%]", "median [ms]", "recordings")
    return Table(columns=(*columns, *more), rows=rows)


def _place(one: Evidence, table: Mapping[str, Sequence[str]]) -> str:
    if one.module not in table[one.scene]:
        return "-"
    place = table[one.scene].index(one.module)
    return f"fallback {place}" if place else "first choice"
