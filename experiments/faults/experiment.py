"""The experiment `faults`: what the bus survives, and how soon.

`conf/experiment/faults.yaml` says how it is called, `experiments/faults/README.md` what was found.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from tqdm import tqdm

from sceneslam.experiments.faults.cut_off import KINDS, Cut, Program, can_mount
from sceneslam.experiments.faults.survival import Survival, survival
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import (
    Figure,
    Relation,
    RunTrials,
    Table,
    Trial,
    TrialResult,
    Verdict,
)
from sceneslam.types.ranges import check_above, check_between, check_least, check_some

_AT_ONCE = 4  # runs that are struck; each waits for the disk most of the time
_log = logging.getLogger(__name__)


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
        cut_offs: dict[str, int],
        cut_off_observations: int,
        lost_max_s: float,
    ) -> None:
        check_least(1, runs=runs)
        check_least(0, seed=seed, faults_min=faults_min)
        check_above(0, right_m=right_m, recovery_max_s=recovery_max_s)
        check_between(0, 1, availability_min=availability_min)
        check_some(struck=struck)
        check_least(0, **{f"cut_offs.{kind}": count for kind, count in cut_offs.items()})
        check_least(1, cut_off_observations=cut_off_observations)
        check_above(0, lost_max_s=lost_max_s)
        for kind in set(cut_offs) - set(KINDS):
            raise ConfigError(f"cut_offs.{kind}", cut_offs[kind], f"a count of {', '.join(KINDS)}")
        self._cut_offs, self._lost_max_s = cut_offs, lost_max_s
        self._cut_off_observations = cut_off_observations
        self._runs, self._struck, self._seed, self._right_m = runs, struck, seed, right_m
        self._faults_min = faults_min
        self._availability_min, self._recovery_max_s = availability_min, recovery_max_s

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Run them; return what was struck and what held."""
        trials = [self._trial(index, folder.resolve()) for index in range(self._runs)]
        found = [self._survival(outcome) for outcome in run_trials(trials)]
        cuts = self._cut_off(folder, folder / "runs" / trials[0].name / "config.yaml")
        figures = [*self._figures(found), *self._cut_figures(cuts)]
        return Verdict(figures=figures, table=_table(found, cuts))

    def _cut_off(self, folder: Path, config: Path) -> list[Cut]:
        """Strike runs of the first trial's configuration, without its own faults, from outside."""
        if not any(self._cut_offs.values()):
            return []
        plain: Any = OmegaConf.to_container(OmegaConf.load(config))
        # The last module for all scenes, which is a cheap one: it is the program that is struck.
        module = [node["module"] for node in plain["slam"].values()][-1]
        plain["slam"] = dict.fromkeys(plain["slam"], module)
        plain["effects"] = None
        plain["run"] |= {"isolation": "inline", "max_observations": self._cut_off_observations}
        plain["run"] |= {"progress": True}
        mcap = {"_target_": "sceneslam.sinks.mcap.McapSink", "path": "run.mcap"}
        every = {"jpeg_quality": 95, "image_every": 1, "depth_every": 1}
        plain["sinks"] = {"mcap": mcap | {"image_format": "png"} | every}
        place = folder / "cut_offs"
        counts = {**self._cut_offs}
        if counts.get("disk") and not can_mount(place / "disk"):
            _log.warning("faults.cut_offs.disk: left out, disks are the administrator's to make")
            counts["disk"] = 0
        cases = [(kind, number) for kind, count in counts.items() for number in range(count)]
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        program = Program(config=plain, folder=place)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            cuts = pool.map(lambda case: program.strike(case[0], self._seed + case[1]), cases)
            return list(tqdm(cuts, "cut off", len(cases), unit="run", leave=False))

    def _cut_figures(self, cuts: Sequence[Cut]) -> list[Figure]:
        if not cuts:
            return []
        lost_s = max(cut.lost_s for cut in cuts)
        wrong = sum(not cut.is_right for cut in cuts)
        at_most = Figure.at_most
        return [
            Figure.at_least("programs struck", len(cuts), sum(self._cut_offs.values())),
            at_most("reported poses lost, most of all", lost_s, self._lost_max_s, "s"),
            at_most("results other than undisturbed", wrong, 0),
            at_most("foreign files touched", sum(cut.foreign for cut in cuts), 0),
            at_most("torn files", sum(len(cut.torn) for cut in cuts), 0),
        ]

    def _trial(self, index: int, folder: Path) -> Trial:
        name = f"run_{index:03d}"
        values: dict[str, object] = {}
        for place, key in enumerate(self._struck):
            record = folder / "runs" / name / _record(key)
            seed = self._seed + index * len(self._struck) + place
            _put(values, key, {"seed": seed, "record": str(record)})
        return Trial(name=name, values=values)

    def _survival(self, outcome: TrialResult) -> Survival:
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


def _table(found: Sequence[Survival], cuts: Sequence[Cut]) -> Table:
    """Return one row per kind of fault; of the program's, how many runs it cut off."""
    kinds = sorted({strike.kind for one in found for strike in one.strikes})
    rows: list[list[str | float | None]] = []
    for kind in kinds:
        strikes = [strike for one in found for strike in one.strikes if strike.kind == kind]
        took_s = [strike.recovery_s for strike in strikes]
        clock_ms = 1e3 * float(np.quantile([strike.clock_s for strike in strikes], 0.95))
        finite_s = [value for value in took_s if np.isfinite(value)]
        never = len(took_s) - len(finite_s)
        spread_ms = np.quantile(finite_s or [np.nan], [0.5, 0.95, 1.0]) * 1e3
        rows.append([kind, float(len(took_s)), *spread_ms.tolist(), float(never), clock_ms])
    for kind in dict.fromkeys(cut.kind for cut in cuts):
        of_kind = [cut for cut in cuts if cut.kind == kind]
        lost_ms = np.quantile([cut.lost_s for cut in of_kind], [0.5, 0.95, 1.0]) * 1e3
        was_cut = float(sum(cut.was_cut for cut in of_kind))
        rows.append([f"program: {kind}", float(len(of_kind)), *lost_ms.tolist(), was_cut, None])
    columns = ["fault", "times", "median [ms]", "p95 [ms]", "max [ms]"]
    columns += ["not before the end", "p95 by the clock [ms]"]
    return Table(columns=columns, rows=rows)
