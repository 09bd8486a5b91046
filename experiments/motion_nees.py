"""Print whether modules move as far off as their covariances say, each of them alone.

    python experiments/motion_nees.py MODULE[,MODULE...] [alone] [plane] [OVERRIDES]

The overrides choose a recording as for a run; several seeds of a story are given as
`seed=0,1,2`. With `alone` nothing but the module's own sensor is told: no wheels, no gyro, no
accelerometer. With `plane` only x, y and yaw are looked at, for modules that know no more. The
motion from one pose that is TRACKING to another, 0.1 to 10 s later, is held against the true one.
What it claims is the sum of the two poses' covariances: they are beside the module's own map,
whose drift is not in them, so over the longer times a module that draws a new map must come out
too certain. NEES: normalised estimation error squared (Bar-Shalom, Li, Kirubarajan 2001, Sec.
5.4), over its expectation, the number of axes. The result is a Markdown table.
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from gaps import alone
from numpy.typing import NDArray
from rgbd_nees import UNITS, seeds_of

from sceneslam.evaluation.association import interpolated
from sceneslam.experiments.scripts import single
from sceneslam.interfaces import SlamModule
from sceneslam.types import se3
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.trajectory import Trajectory

APART_S = (0.1, 1.0, 10.0)
PARTS = {"position": [0, 1, 2], "rotation": [3, 4, 5]}
PARTS_IN_PLANE = {"position": [0, 1], "rotation": [5]}
UNUSUAL = {1: 6.635, 2: 9.210, 3: 11.345}  # 99 % of chi-squared, by degrees of freedom

Motions = tuple[NDArray[np.float64], NDArray[np.float64]]  # errors (N, 6), covariances (N, 6, 6)


def follow(
    module_name: str, overrides: list[str], *, is_alone: bool
) -> tuple[list[Tracking], Trajectory]:
    """Return a module's answers, and the true poses."""
    source, builder = single(module_name, *overrides)
    module = builder.make("slam.only", SlamModule)
    module.activate(source.rig)
    truth = source.ground_truth()
    if truth is None:
        raise SystemExit("motion_nees: the recording has no ground truth, choose another")
    answers = [module.track(alone(one) if is_alone else one) for one in source]
    module.shutdown()
    return answers, truth.trajectory


def motions(answers: list[Tracking], truth: Trajectory, apart_s: float) -> Motions:
    """Return how far off motions of `apart_s` are, and what they claim to be."""
    begin_ns, end_ns = truth.stamps_ns[0], truth.stamps_ns[-1]
    sure = [
        one
        for one in answers
        if one.status is TrackingStatus.TRACKING
        and one.covariance is not None
        and begin_ns <= one.stamp_ns <= end_ns
    ]
    stamps_ns = np.array([one.stamp_ns for one in sure], dtype=np.int64)
    later = np.searchsorted(stamps_ns, stamps_ns + round(apart_s * 1e9))
    first = np.flatnonzero(later < len(sure))
    later = later[first]
    near = stamps_ns[later] - stamps_ns[first] <= 1.5e9 * apart_s
    first, later = first[near], later[near]
    if not len(first):
        return np.empty((0, 6)), np.empty((0, 6, 6))
    T_local = np.stack([one.T_local_base for one in sure])
    covariances = np.stack([one.covariance for one in sure if one.covariance is not None])
    T_gt = interpolated(truth, stamps_ns).T_world_base
    moved, truly = (se3.inverse(T[first]) @ T[later] for T in (T_local, T_gt))
    backwards = se3.inverse(moved)
    return (
        se3.log(backwards @ truly),
        covariances[later] + se3.carried(covariances[first], backwards),
    )


def row(name: str, apart_s: float, found: Motions, parts: dict[str, list[int]]) -> str:
    """Return a line of the table."""
    errors, covariances = found
    cells = [name, f"{apart_s:g} s", str(len(errors))]
    for part, axes in parts.items():
        if not len(errors):
            cells += ["-", "-", "-"]
            continue
        error, covariance = errors[:, axes], covariances[np.ix_(range(len(errors)), axes, axes)]
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
        claimed = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        off, said = (1e3 * np.median(each) for each in (np.linalg.norm(error, axis=1), claimed))
        cells += [
            f"{off:.1f}, {said:.1f} {UNITS[part]}",
            f"{nees.mean() / len(axes):.2g}, {np.median(nees) / len(axes):.2g}",
            f"{100 * (nees > UNUSUAL[len(axes)]).mean():.0f} %",
        ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    cv2.setNumThreads(1)
    modules, words = sys.argv[1].split(","), sys.argv[2:]
    parts = PARTS_IN_PLANE if "plane" in words else PARTS
    others = [w for w in words if w not in ("alone", "plane") and not w.startswith("seed=")]
    runs = [[*others, f"seed={seed}"] for seed in seeds_of(words)] or [others]
    print(
        "| module | over | motions "
        "| position: off, claimed | NEES: mean, median | beyond 99 % "
        "| rotation: off, claimed | NEES: mean, median | beyond 99 % |\n" + "|---" * 9 + "|"
    )
    for module in modules:
        followed = [follow(module, run, is_alone="alone" in words) for run in runs]
        for apart_s in APART_S:
            found = zip(*(motions(*each, apart_s) for each in followed), strict=True)
            errors, covariances = map(np.concatenate, found)
            print(row(module, apart_s, (errors, covariances), parts), flush=True)


if __name__ == "__main__":
    main()
