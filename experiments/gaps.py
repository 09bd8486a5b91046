"""Print where a module says to be after seconds without any data, without wheels and gyro.

    python experiments/gaps.py MODULE [backwards] [--gaps SECONDS,...] [--of COUNT] [OVERRIDES]

The overrides choose a recording as for a run:

    python experiments/gaps.py laser source=carmen source.path=LOG
    python experiments/gaps.py depth backwards source=tum_rgbd source.path=FOLDER

A gap begins at each of 15 instants of the first 5000 observations, and ends after 1.5, 4 or 10 s.
A module is found again with its first pose that is not LOST, of 60 observations. The fifth after it
is compared with the ground truth, or without one with the same module's where there are wheels,
gyro and no gap: `wrong` above 0.3 m or 0.2 rad, `inconsistent` if that is also beyond three
standard deviations of its covariances. The result is a Markdown table.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import interpolated
from sceneslam.experiments.scripts import backwards, single
from sceneslam.interfaces import SlamModule, Source
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Sensor

GAPS_S = "1.5,4,10"
STARTS, OBSERVATIONS = 15, 5000
PATIENCE, JUDGED_AFTER = 60, 5  # observations
WRONG = np.array([0.3, 0.2])  # m, rad


@dataclass(frozen=True)
class Return:
    """How far off the module is after a gap, and what it says of that: [m, rad]."""

    error: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @property
    def is_wrong(self) -> bool:
        """Tell whether it says to be at another place."""
        return bool((self.error > WRONG).any())

    @property
    def is_inconsistent(self) -> bool:
        """Tell whether that is beyond its covariances, too."""
        return bool((self.error > np.maximum(WRONG, 3.0 * self.deviation)).any())


def alone(observation: Observation) -> Observation:
    """Return an observation without wheels and inertial sensors."""
    return replace(observation, T_odom_base=None, gyro_base=None, accelerometer_base=None)


def reference(
    module: SlamModule, source: Source, observations: Sequence[Observation]
) -> NDArray[np.float64]:
    """Return the poses (N, 4, 4) that answers are held against."""
    truth = source.ground_truth()
    if truth is None or not len(truth.trajectory):
        module.activate(source.rig)
        return np.array([module.track(one).T_local_base for one in observations])
    stamps_ns = np.array([one.stamp_ns for one in observations])
    return interpolated(truth.trajectory, np.sort(stamps_ns)).T_world_base


def deviation(answer: Tracking) -> NDArray[np.float64]:
    """Return the standard deviations (2,) [m, rad] that an answer has."""
    said = [one for one in (answer.covariance, answer.map_covariance) if one is not None]
    covariance = np.sum([np.zeros((6, 6)), *said], axis=0)
    parts = covariance[:3, :3], covariance[3:, 3:]
    return np.sqrt([np.linalg.eigvalsh(part)[-1] for part in parts])


def returned(
    module: SlamModule, observations: Sequence[Observation], T: NDArray[np.float64], last: Tracking
) -> Return | None:
    """Return the answer of a module that goes on here; None if it stays lost.

    `T` (N + 1, 4, 4) are the right poses, of the last answer `last` before the gap first.
    """
    since = 0
    for observation, T_true in zip(observations, T[1:], strict=True):
        answer = module.track(observation)
        since += since > 0 or answer.status is not TrackingStatus.LOST
        if since > JUDGED_AFTER:
            moved = se3.inverse(last.T_local_base) @ answer.T_local_base
            off = se3.inverse(se3.inverse(T[0]) @ T_true) @ moved
            error = np.linalg.norm(off[:3, 3]), se3.rotation_angle_rad(off)
            return Return(np.array(error), deviation(answer))
    return None


def copied(
    module: SlamModule, started: Callable[[], SlamModule], before: Sequence[Observation]
) -> SlamModule:
    """Return a module in the same state; one that cannot be copied sees all again."""
    try:
        return copy.deepcopy(module)
    except TypeError:  # a library's object
        again = started()
        for observation in before:
            again.track(observation)
        return again


def main(name: str, overrides: Sequence[str], gaps_s: Sequence[float], patience: int) -> None:
    """Play the recording once, and a copy of the module after each gap."""
    is_backwards = "backwards" in overrides
    source, builder = single(name, *(word for word in overrides if word != "backwards"))
    observations = list(islice(source, OBSERVATIONS))
    T = reference(builder.make("slam.only", SlamModule), source, observations)
    if is_backwards:
        observations, T = backwards(observations), T[::-1]
    observations = [alone(observation) for observation in observations]
    stamps_s = 1e-9 * np.array([one.stamp_ns for one in observations])
    bare = source.rig.sensors - {Sensor.ODOMETRY, Sensor.GYRO, Sensor.ACCELEROMETER}

    def started() -> SlamModule:
        module = builder.make("slam.only", SlamModule)
        module.activate(replace(source.rig, sensors=bare))
        return module

    starts = set(np.linspace(0.25, 0.9, STARTS) * len(observations) // 1)
    returns: dict[float, list[Return | None]] = {gap_s: [] for gap_s in gaps_s}
    module = started()
    answer = module.track(observations[0])
    for index, observation in enumerate(observations[1:], 1):
        for gap_s in gaps_s if index in starts else ():
            first = int(np.searchsorted(stamps_s, stamps_s[index - 1] + gap_s))
            after = slice(first, first + patience)
            right = np.concatenate([T[index - 1 : index], T[after]])
            if len(right) == patience + 1:
                again = copied(module, started, observations[:index])
                returns[gap_s].append(returned(again, observations[after], right, answer))
        answer = module.track(observation)
    print("| gap [s] | gaps | found | wrong | inconsistent |\n| --- | --- | --- | --- | --- |")
    for gap_s, some in returns.items():
        found = [one for one in some if one is not None]
        wrong = sum(one.is_wrong for one in found)
        beyond = sum(one.is_inconsistent for one in found)
        print(f"| {gap_s:g} | {len(some)} | {len(found)} | {wrong} | {beyond} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(usage=__doc__)
    parser.add_argument("module")
    parser.add_argument("--gaps", default=GAPS_S)
    parser.add_argument("--of", type=int, default=PATIENCE)
    known, words = parser.parse_known_args()
    main(known.module, words, [float(gap_s) for gap_s in known.gaps.split(",")], known.of)
