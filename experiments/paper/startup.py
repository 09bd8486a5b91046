"""IV-E: how long a module takes to start, and a switch to be over."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median

from sceneslam.experiments.paper.runs import events_of
from sceneslam.types.errors import InputError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_least, check_some

Row = tuple[str, str, float, float, float]


class StartupExperiment:
    """Starts every module in fresh processes, and times the switches of some stories."""

    def __init__(
        self,
        *,
        modules: Sequence[str],
        overrides: Sequence[str],
        repeats: int,
        stories: Sequence[str],
        start_max_s: float,
        first_pose_max_s: float,
        switch_max_s: float,
    ) -> None:
        check_some(modules=modules, stories=stories)
        check_least(1, repeats=repeats)
        check_above(0, start_max_s=start_max_s, first_pose_max_s=first_pose_max_s)
        check_above(0, switch_max_s=switch_max_s)
        self._modules, self._overrides, self._repeats = modules, overrides, repeats
        self._stories, self._start_max_s = stories, start_max_s
        self._first_pose_max_s, self._switch_max_s = first_pose_max_s, switch_max_s

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return the medians of the starts, and every switch."""
        trials = [Trial(name=story, overrides=(f"story={story}",)) for story in self._stories]
        outcomes = list(run_trials(trials))
        starts = {key: self._start(key) for key in self._modules}
        switches = [row for outcome in outcomes for row in _switches(outcome)]
        return Verdict(
            figures=list(self._figures(starts, switches)), table=_table(starts, switches)
        )

    def _start(self, key: str) -> Mapping[str, float]:
        """Return the median times of a module's start."""
        command = [sys.executable, "-m", "sceneslam.experiments.paper.ready", f"slam.{key}"]
        found = []
        for _ in range(self._repeats):
            done = subprocess.run([*command, *self._overrides], capture_output=True, text=True)
            if done.returncode:
                raise InputError(f"slam.{key} did not start: {done.stderr.strip()[-200:]}")
            found.append(json.loads(done.stdout.splitlines()[-1]))
        return {name: median(one[name] for one in found) for name in found[0]}

    def _figures(
        self, starts: Mapping[str, Mapping[str, float]], switches: Sequence[Row]
    ) -> Iterator[Figure]:
        for key, times in starts.items():
            name = f"{key}: start, libraries and first pose included"
            yield Figure.at_most(name, times["first_pose_s"], self._start_max_s, "s")
        for name, to, first_s, whole_s, _ in switches:
            start_s = starts[to]["first_pose_s"] if to in starts else math.nan
            yield Figure.at_most(f"{name}: first pose over that of a start", first_s / start_s, 1.0)
            yield Figure.at_most(
                f"{name}: decision to first pose", first_s, self._first_pose_max_s, "s"
            )
            yield Figure.at_most(f"{name}: decision to caught up", whole_s, self._switch_max_s, "s")


def _switches(outcome: TrialResult) -> Iterator[Row]:
    """Yield the wall-clock costs of a run's switches; the first decision is the run's start."""
    costs = {event["stamp_ns"]: event for event in events_of(outcome, "cost")}
    for switch in outcome.metrics["switches"]:
        cost = costs[switch["stamp_ns"]]
        name = f"{outcome.trial.name}, {switch['from']} -> {switch['to']}"
        yield (
            name,
            switch["to"],
            cost["first_pose_ms"] / 1e3,
            cost["handover_ms"] / 1e3,
            cost["catch_up_s"],
        )


def _table(starts: Mapping[str, Mapping[str, float]], switches: Sequence[Row]) -> Table:
    columns = ("what", "built, or first pose [s]", "first pose, or caught up [s]", "of data [s]")
    rows: list[tuple[str | float | None, ...]] = [
        (f"start of {key}", times["built_s"], times["first_pose_s"], None)
        for key, times in starts.items()
    ]
    return Table(columns=columns, rows=[*rows, *((row[0], *row[2:]) for row in switches)])
