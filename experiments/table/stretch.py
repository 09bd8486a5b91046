"""Stretches of a recording by scene, and how a module did on each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import relative_errors
from sceneslam.evaluation.association import covered, interpolated
from sceneslam.types.experiment import TrialResult
from sceneslam.types.run import Event
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import TRUTH_GAP_S

_STAMP_GAP_S = 0.005  # stamps are the recording's own


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Between two confirmed changes; each begins with the first image that showed the scene."""

    scene: str
    begin_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motions:
    """The motions over an interval that lie within one scene's stretches of a recording."""

    scene: str
    due: int  # how many the truth knows
    trans_m: NDArray[np.float64]  # (N,) errors of those that the module gave
    rot_rad: NDArray[np.float64]  # (N,)


def measure(outcome: TrialResult, interval_s: float) -> list[Motions]:
    """Return the motions of a module that ran alone, stretch by stretch.

    Only what the module itself told counts: each of its sessions for itself, nothing bridged.
    """
    with (outcome.folder / "events.jsonl").open() as file:
        events: list[Event] = [json.loads(line) for line in file]
    truth = Trajectory.read_tum(outcome.folder / "groundtruth.tum")
    paths = sorted(outcome.folder.glob("trajectory_[0-9]*.tum"))
    sessions = [Trajectory.read_tum(path) for path in paths]
    votes = [event["stamp_ns"] for event in events if event["event"] == "vote"]
    observed_ns = np.array(votes, np.int64)  # the detector is asked about every observation
    return [
        _measure(stretch, sessions, truth, observed_ns, interval_s)
        for stretch in stretches_of(events)
    ]


def stretches_of(events: Sequence[Event]) -> Sequence[Stretch]:
    """Return the stretches of a run by its own log."""
    changes = [event for event in events if event["event"] == "scene"]
    begins = [event["since_ns"] for event in changes]
    last_ns = max((event["stamp_ns"] for event in events), default=0)
    return [
        Stretch(scene=event["scene"], begin_ns=begin_ns, end_ns=end_ns)
        for event, begin_ns, end_ns in zip(changes, begins, [*begins[1:], last_ns + 1], strict=True)
    ]


def _measure(
    stretch: Stretch,
    sessions: Sequence[Trajectory],
    truth: Trajectory,
    observed_ns: NDArray[np.int64],
    interval_s: float,
) -> Motions:
    inside_ns = observed_ns[_inside(observed_ns, stretch)]
    known_ns = inside_ns[covered(truth, inside_ns, TRUTH_GAP_S)]
    true = interpolated(truth, known_ns) if len(known_ns) else Trajectory.empty()
    due = relative_errors(true, true, _STAMP_GAP_S, interval_s)
    told = [
        relative_errors(_cut(session, stretch), true, _STAMP_GAP_S, interval_s)
        for session in sessions
    ]
    return Motions(
        scene=stretch.scene,
        due=len(due.trans_m),
        trans_m=np.concatenate([np.zeros(0), *(one.trans_m for one in told)]),
        rot_rad=np.concatenate([np.zeros(0), *(one.rot_rad for one in told)]),
    )


def _inside(stamps_ns: NDArray[np.int64], stretch: Stretch) -> NDArray[np.bool_]:
    return (stamps_ns >= stretch.begin_ns) & (stamps_ns < stretch.end_ns)


def _cut(trajectory: Trajectory, stretch: Stretch) -> Trajectory:
    kept = _inside(trajectory.stamps_ns, stretch)
    return Trajectory(
        stamps_ns=trajectory.stamps_ns[kept], T_world_base=trajectory.T_world_base[kept]
    )
