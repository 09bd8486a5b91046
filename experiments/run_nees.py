"""Print whether a run's poses are as far off as its covariances say.

    python experiments/run_nees.py FOLDER [FOLDER ...]

FOLDER is that of a run with ground truth. Nothing is aligned: estimate and truth begin at the same
pose. NEES over its expectation is 1 where a covariance is right (Bar-Shalom, Li, Kirubarajan 2001,
Sec. 5.4); the poses of one run are no independent samples, so that a single run says little about
a factor of two.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from sceneslam.atlas.uncertainty import read_covariances
from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

_FLOOR = 1e-4  # m and rad: below, nothing is known of a truth
_PARTS = (("position", slice(0, 3)), ("rotation", slice(3, 6)))


def main(folders: list[str]) -> None:
    """Print two lines per folder."""
    print("| run | of | error, claimed: RMS | NEES / expectation: mean, median |")
    print("| --- | --- | --- | --- |")
    for folder in map(Path, folders):
        run = Trajectory.read_tum(folder / "trajectory.tum")
        truth = Trajectory.read_tum(folder / "groundtruth.tum")
        stamps_ns = run.stamps_ns
        known = (stamps_ns >= truth.stamps_ns[0]) & (stamps_ns <= truth.stamps_ns[-1])
        poses = run.T_world_base[known]
        true = interpolated(truth, stamps_ns[known]).T_world_base
        errors = se3.log(se3.inverse(poses) @ poses[0] @ se3.inverse(true[0]) @ true)[1:]
        claimed = read_covariances(folder / "trajectory_covariance.txt")[1][known][1:]
        for name, axes in _PARTS:
            off, allowed = errors[:, axes], claimed[:, axes, axes] + _FLOOR**2 * np.eye(3)
            nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(allowed), off) / 3
            sizes = (off**2).sum(axis=1), np.trace(allowed, axis1=1, axis2=2)
            error, claim = (1e3 * np.sqrt(size.mean()) for size in sizes)
            figures = f"{error:.1f}, {claim:.1f} | {nees.mean():.3g}, {np.median(nees):.3g}"
            print(f"| {folder.name} | {name} [{'mm' if axes.start == 0 else 'mrad'}] | {figures} |")


if __name__ == "__main__":
    main(sys.argv[1:])
