"""Runs that no one ran: folders with what an experiment reads, made up."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sceneslam.types.experiment import RunTrials, Trial, TrialResult
from sceneslam.types.trajectory import Trajectory


@dataclass
class Told:
    """What a run is said to have given."""

    metrics: Mapping[str, Any] = field(default_factory=dict)
    events: Sequence[Mapping[str, Any]] = ()
    trajectory: Trajectory = field(default_factory=Trajectory.empty)
    truth: Trajectory | None = None
    sessions: Mapping[str, Trajectory] = field(default_factory=dict)


def teller(folder: Path, tell: Callable[[Trial], Told]) -> RunTrials:
    """Return what an experiment calls to run trials; their folders are below `folder`."""

    def run_trials(trials: Iterable[Trial]) -> Iterator[TrialResult]:
        for trial in trials:
            yield _outcome(folder / trial.name, trial, tell(trial))

    return run_trials


def _outcome(folder: Path, trial: Trial, told: Told) -> TrialResult:
    folder.mkdir(parents=True)
    (folder / "events.jsonl").write_text("".join(json.dumps(e) + "\n" for e in told.events))
    if told.truth is not None:
        told.truth.write_tum(folder / "groundtruth.tum")
    for name, trajectory in told.sessions.items():
        trajectory.write_tum(folder / f"trajectory_{name}.tum")
    return TrialResult(
        trial=trial,
        folder=folder,
        metrics=told.metrics,
        trajectory=told.trajectory,
        online=told.trajectory,
        faults=(),
    )
