"""The experiment `faults`: what the bus survives, and how soon.

`conf/experiment/faults.yaml` says how it is called, `experiments/faults/README.md` what was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneslam.experiments.faults.survival import Survival, survival
from sceneslam.types.experiment import Figure, Outcome, Relation, RunTrials, Table, Trial, Verdict
from sceneslam.types.ranges import check_above, check_between, check_least, check_some


class FaultsExperiment:
    """Runs one drive again and again, with other faults each time.

    `struck` names the components of the configuration that are faulty: each gets a seed and a
    record of its own in every run.
    """

    def __init__(
        self,
        *,
        runs: int,
        struck: list[str],
        seed: int,
        right_m: float,
        faults_min: int,
        availability_min: float,
        recovery_max_s: float,
    ) -> None:
        check_least(1, runs=runs)
        check_least(0, seed=seed, faults_min=faults_min)
        check_above(0, right_m=right_m, recovery_max_s=recovery_max_s)
        check_between(0, 1, availability_min=availability_min)
        check_some(struck=struck)
        self._runs, self._struck, self._seed, self._right_m = runs, struck, seed, right_m
        self._faults_min = faults_min
        self._availability_min, self._recovery_max_s = availability_min, recovery_max_s

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run them; return what was struck and what held."""
        trials = [self._trial(index, folder.resolve()) for index in range(self._runs)]
        found = [self._survival(outcome) for outcome in run_trials(trials)]
        return Verdict(figures=self._figures(found), table=_table(found))

    def _trial(self, index: int, folder: Path) -> Trial:
        name = f"run_{index:03d}"
        values: dict[str, object] = {}
        for place, key in enumerate(self._struck):
            record = folder / "runs" / name / _record(key)
            record.unlink(missing_ok=True)
            seed = self._seed + index * len(self._struck) + place
            _put(values, key, {"seed": seed, "record": str(record)})
        return Trial(name=name, values=values)

    def _survival(self, outcome: Outcome) -> Survival:
        records = [outcome.folder / _record(key) for key in self._struck]
        return survival(outcome.trial.name, outcome.folder, records, right_m=self._right_m)

    def _figures(self, found: Sequence[Survival]) -> list[Figure]:
        recoveries_s = [strike.recovery_s for one in found for strike in one.strikes]
        observations = sum(one.observations for one in found)
        poses = sum(one.poses for one in found)
        end_ns = max(one.last_ns for one in found)
        deaths = sum(end_ns - one.last_ns > 10**9 for one in found)  # it did not see the end
        p95_s = float(np.quantile(recoveries_s, 0.95, method="higher")) if recoveries_s else np.nan
        at_least, at_most = Relation.AT_LEAST, Relation.AT_MOST
        return [
            Figure(
                name="faults", value=len(recoveries_s), relation=at_least, bound=self._faults_min
            ),
            Figure(name="bus deaths", value=deaths, relation=at_most, bound=0),
            Figure(
                name="pose availability",
                value=100.0 * poses / observations,
                relation=at_least,
                bound=100.0 * self._availability_min,
                unit="%",
            ),
            Figure(
                name="recovery, 95th percentile",
                value=p95_s,
                relation=at_most,
                bound=self._recovery_max_s,
                unit="s",
            ),
            Figure(
                name="files lost or torn",
                value=sum(len(one.damage) for one in found),
                relation=at_most,
                bound=0,
            ),
        ]


def _record(key: str) -> str:
    return f"faults_{key.replace('.', '_')}.jsonl"


def _put(values: dict[str, object], key: str, content: object) -> None:
    """Put a value at a dotted key."""
    first, _, rest = key.partition(".")
    if not rest:
        values[first] = content
        return
    inner = values.setdefault(first, {})
    assert isinstance(inner, dict)
    _put(inner, rest, content)


def _table(found: Sequence[Survival]) -> Table:
    """Return one row per kind of fault."""
    kinds = sorted({strike.kind for one in found for strike in one.strikes})
    rows: list[list[str | float | None]] = []
    for kind in kinds:
        took_s = [s.recovery_s for one in found for s in one.strikes if s.kind == kind]
        finite_s = [value for value in took_s if np.isfinite(value)]
        never = len(took_s) - len(finite_s)
        spread_ms = np.quantile(finite_s or [np.nan], [0.5, 0.95, 1.0]) * 1e3
        rows.append([kind, float(len(took_s)), *spread_ms.tolist(), float(never)])
    columns = ["fault", "times", "median [ms]", "p95 [ms]", "max [ms]", "not before the end"]
    return Table(columns=columns, rows=rows)
