"""How a run with faults went: its poses, how soon each fault was over, what is left on disk."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.experiments.faults.witness import TOLD, TRUTH
from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Strike:
    """One fault, and how long it was until a right pose was out again."""

    kind: str
    recovery_s: float  # in the recording's time; inf: never in this run
    clock_s: float  # by the clock: deadlines, and what a process takes to start on this machine


@dataclass(frozen=True, slots=True, kw_only=True)
class Survival:
    """One run."""

    name: str
    observations: int
    poses: int
    last_ns: int
    strikes: Sequence[Strike]
    damage: Sequence[str]  # what is missing or torn in its folder


def survival(name: str, folder: Path, records: Sequence[Path], *, right_m: float) -> Survival:
    """Return how a run went; a pose is right within `right_m` of the truth."""
    told = np.load(folder / TOLD)
    stamps_ns, positions_m = told["stamps_ns"], told["positions_m"]
    errors_m = _errors_m(stamps_ns, positions_m, Trajectory.read_tum(folder / TRUTH))
    lines = [line for path in records if path.exists() for line in path.read_text().splitlines()]
    strikes = []
    for line in map(json.loads, lines):
        is_later = told["clocks_ns"] >= line["clock_ns"]
        # A module on its way to now is struck at a stamp that is long over.
        struck_ns = max([line["stamp_ns"], *stamps_ns[~is_later][-1:]])
        is_right = _is_within(errors_m, is_later, right_m)
        over = np.flatnonzero(is_later & is_right & (stamps_ns >= line["stamp_ns"]))[:1]
        later_s = [float(ns) * 1e-9 for ns in stamps_ns[over] - struck_ns]
        clock_s = [float(ns) * 1e-9 for ns in told["clocks_ns"][over] - line["clock_ns"]]
        strikes.append(
            Strike(
                kind=line["kind"],
                recovery_s=later_s[0] if later_s else np.inf,
                clock_s=clock_s[0] if clock_s else np.inf,
            )
        )
    return Survival(
        name=name,
        observations=len(stamps_ns),
        poses=int(np.isfinite(positions_m).all(axis=1).sum()),
        last_ns=int(stamps_ns[-1]),
        strikes=strikes,
        damage=_damage(folder, len(stamps_ns)),
    )


def _is_within(
    errors_m: NDArray[np.float64], is_later: NDArray[np.bool_], right_m: float
) -> NDArray[np.bool_]:
    """Tell which poses are right, or wrong as the last before the fault was: not its doing."""
    before_m = errors_m[~is_later & np.isfinite(errors_m).all(axis=1)][-1:]
    drift_m = errors_m - (before_m if len(before_m) else 0.0)
    off_m = np.minimum(np.linalg.norm(errors_m, axis=1), np.linalg.norm(drift_m, axis=1))
    return np.asarray(off_m <= right_m)


def _errors_m(
    stamps_ns: NDArray[np.int64], positions_m: NDArray[np.float64], truth: Trajectory
) -> NDArray[np.float64]:
    """Return where each position is (N, 3) from the true one, both seen from the first."""
    first = int(np.argmax(np.isfinite(positions_m).all(axis=1)))
    start = int(np.abs(truth.stamps_ns - stamps_ns[first]).argmin())
    T_start_gt = np.linalg.inv(truth.T_world_base[start])
    true_m = (T_start_gt @ truth.T_world_base)[:, :3, 3]
    times_s = (stamps_ns - truth.stamps_ns[0]) * 1e-9
    truth_s = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    at_m = np.stack([np.interp(times_s, truth_s, true_m[:, axis]) for axis in range(3)], axis=1)
    return np.asarray(positions_m - at_m)


def _damage(folder: Path, observations: int) -> list[str]:
    """Return what cannot be read of what the run wrote, or is not all there."""
    damage = []
    for name in ("trajectory_online.tum", "trajectory.tum"):
        poses = len(Trajectory.read_tum(folder / name))
        if poses > observations or (folder / name).read_bytes()[-1:] != b"\n":
            damage.append(f"{name}: {poses} poses of {observations} observations")
    votes = _count_votes(folder / "events.jsonl")
    if votes != observations:
        damage.append(f"events.jsonl: {votes} votes of {observations} observations")
    metrics = json.loads((folder / "metrics.json").read_text())
    if round(metrics["coverage"] * observations) != len(Trajectory.read_tum(folder / name)):
        damage.append("metrics.json: its coverage is not that of the trajectory")
    return damage + _damage_of_map(folder / "map")


def _count_votes(path: Path) -> int:
    """Return how many votes, one per observation, are in the log before the first torn line."""
    votes = 0
    for line in path.read_text().splitlines():
        try:
            votes += json.loads(line)["event"] == "vote"
        except json.JSONDecodeError:
            break
    return votes


def _damage_of_map(folder: Path) -> list[str]:
    """Return whether the points are as many as the file's head says, three floats or more each."""
    head, _, body = (folder / "points.ply").read_bytes().partition(b"end_header\n")
    counts = [int(line.split()[-1]) for line in head.splitlines() if line.startswith(b"element")]
    return [] if len(body) >= 12 * sum(counts) else ["points.ply: it is cut off"]
