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

from sceneslam.experiments.handover.consistency import errors_of, normalised

_PARTS = (("position [mm]", [0, 1, 2]), ("rotation [mrad]", [3, 4, 5]))


def main(folders: list[str]) -> None:
    """Print two lines per folder."""
    print("| run | of | error, claimed: RMS | NEES / expectation: mean, median |")
    print("| --- | --- | --- | --- |")
    for folder in map(Path, folders):
        _, errors, covariances = (of[1:] for of in errors_of(folder))  # the first is 0
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        for part, axes in _PARTS:
            nees = normalised(errors, covariances, axes) / len(axes)
            squares = errors[:, axes] ** 2, variances[:, axes]
            error, claimed = (1e3 * np.sqrt(each.sum(axis=1).mean()) for each in squares)
            print(
                f"| {folder.name} | {part} | {error:.1f}, {claimed:.1f} "
                f"| {nees.mean():.3g}, {np.median(nees):.3g} |"
            )


if __name__ == "__main__":
    main(sys.argv[1:])
