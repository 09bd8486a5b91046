"""The experiment `liars`: the same drives with wheel odometry that lies, in every way known.

`conf/experiment/liars.yaml` says how it is called, `experiments/liars/README.md` what was found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sceneslam.evaluation.relations import Relations, relation_errors
from sceneslam.types.errors import InputError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_least, check_some

CLEAN = "none"
SWITCHED = "switched"
_UNITS = {False: "[m]", True: "ATE [m] (correct)"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """A recording or a story, and who drives it."""

    name: str
    module: str  # alone, or SWITCHED
    overrides: tuple[str, ...]
    relations: Path | None = None  # true relative poses of a log

    def error_m(self, outcome: TrialResult) -> float:
        """Return the mean error of the relations, else the ATE; NaN where neither is known.

        NaN breaks the promise. Raises InputError if the relations cannot be read.
        """
        if self.relations is not None:
            relations = Relations.read(self.relations)
            try:
                return relation_errors(outcome.trajectory, relations)["trans_mean_m"]
            except InputError:  # no pose at their instants
                return math.nan
        ate_m = outcome.metrics["ate_rmse_m"]
        return math.nan if ate_m is None else float(ate_m)


class LiarsExperiment:
    """Compares every lie with the honest wheels of the same drive.

    `logs`: name -> {log, relations}, CARMEN logs that `laser` drives. `stories` of the simulator
    are driven by their scenario's modules, switched, and by each of `alone`.
    """

    def __init__(
        self,
        *,
        logs: Mapping[str, Mapping[str, str]],
        log_observations: int | None,
        stories: Sequence[str],
        alone: Sequence[str],
        lies: Mapping[str, Mapping[str, Any]],
        story_every_s: float,
        laser_ratio_max: float,
        absent_max_m: Mapping[str, float],
        moved_max_m: float,
        moved_ratio_max: float,
        correct_min: float,
    ) -> None:
        check_some(lies=lies)
        check_above(0, story_every_s=story_every_s, laser_ratio_max=laser_ratio_max)
        check_above(0, absent_max_m=absent_max_m)
        check_least(0, moved_max_m=moved_max_m, moved_ratio_max=moved_ratio_max)
        if log_observations is not None:
            check_least(1, log_observations=log_observations)
        self._lies = {CLEAN: {"lie": "none"}, **lies}
        self._laser_ratio_max, self._absent_max_m = laser_ratio_max, absent_max_m
        self._moved_max_m, self._moved_ratio_max = moved_max_m, moved_ratio_max
        self._correct_min, self._story_every_s = correct_min, story_every_s
        limit = f"run.max_observations={'null' if log_observations is None else log_observations}"
        self._drives = [
            *(_log(name, paths, limit) for name, paths in logs.items()),
            *(_story(story, module) for story in stories for module in (SWITCHED, *alone)),
        ]
        check_some(logs_and_stories=self._drives)

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Drive everything with every lie; return the errors and what holds of them."""
        pairs = [(drive, lie) for drive in self._drives for lie in self._lies]
        outcomes = run_trials([self._trial(*pair) for pair in pairs])
        errors_m: dict[tuple[str, str, str], float] = {}
        correct: dict[tuple[str, str, str], float] = {}
        for (drive, lie), outcome in zip(pairs, outcomes, strict=True):
            key = (drive.name, drive.module, lie)
            errors_m[key] = drive.error_m(outcome)
            rate = outcome.metrics["correct_rate"]
            correct[key] = math.nan if rate is None else float(rate)
        figures = [
            figure
            for drive in self._drives
            for lie in self._lies
            for figure in self._figures(drive, lie, errors_m, correct)
        ]
        return Verdict(figures=figures, table=self._table(errors_m, correct))

    def _trial(self, drive: Drive, lie: str) -> Trial:
        return Trial(
            name=f"{drive.name}/{drive.module}/{lie.replace(' ', '_')}",
            overrides=drive.overrides,
            values={"effects": {**self._often(drive), **self._lies[lie]}},
        )

    def _often(self, drive: Drive) -> dict[str, float]:
        return {} if drive.relations is not None else {"every_s": self._story_every_s}

    def _figures(
        self,
        drive: Drive,
        lie: str,
        errors_m: Mapping[tuple[str, str, str], float],
        correct: Mapping[tuple[str, str, str], float],
    ) -> Iterator[Figure]:
        key, name = (drive.name, drive.module, lie), f"{drive.name}, {drive.module}, {lie}"
        clean_m, error_m = errors_m[drive.name, drive.module, CLEAN], errors_m[key]
        if drive.module == SWITCHED:
            yield Figure.at_least(f"{name}: Correct Rate", correct[key], self._correct_min)
        elif lie == CLEAN:
            return
        elif drive.relations is None:
            bound_m = self._moved_ratio_max * clean_m + self._moved_max_m
            yield Figure.at_most(f"{name}: ATE", error_m, bound_m, "m")
        elif lie == "absent" and drive.name in self._absent_max_m:
            bound_m = self._absent_max_m[drive.name]
            yield Figure.at_most(f"{name}: error of relations", error_m, bound_m, "m")
        else:
            bound_m = self._laser_ratio_max * clean_m
            yield Figure.at_most(f"{name}: error of relations", error_m, bound_m, "m")

    def _table(
        self,
        errors_m: Mapping[tuple[str, str, str], float],
        correct: Mapping[tuple[str, str, str], float],
    ) -> Table:
        """Return a row per lie, a column per drive: its error, and how much of it was correct."""
        columns = [
            f"{one.name}, {one.module} {_UNITS[one.relations is None]}" for one in self._drives
        ]
        rows: list[list[str | float | None]] = []
        for lie in self._lies:
            keys = [(drive.name, drive.module, lie) for drive in self._drives]
            rows.append([lie, *(_cell(errors_m[key], correct[key]) for key in keys)])
        return Table(columns=("wheels", *columns), rows=rows)


def _cell(error_m: float, correct_rate: float) -> str:
    """Return an error, with the share of correct poses where the truth is known."""
    if math.isnan(error_m):
        return "-"
    return f"{error_m:.4f}" + ("" if math.isnan(correct_rate) else f" ({correct_rate:.1%})")


def _log(name: str, paths: Mapping[str, str], limit: str) -> Drive:
    overrides = (
        "+scenario=single",
        "slam@slam.only=laser",
        "source=carmen",
        f"source.path={paths['log']}",
        limit,
    )
    relations = Path(paths["relations"])
    return Drive(name=name, module="laser", overrides=overrides, relations=relations)


def _story(story: str, module: str) -> Drive:
    if module == SWITCHED:
        return Drive(name=story, module=module, overrides=(f"+scenario={story}",))
    overrides = ("+scenario=single", f"story={story}", f"slam@slam.only={module}")
    return Drive(name=story, module=module, overrides=overrides)
