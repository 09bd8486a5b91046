"""Print for how long velocities last: their autocorrelation, and the time constants it tells.

    python experiments/velocities.py FILE...    # trajectories (TUM), or CARMEN logs (their wheels)

Velocities are in the base's axes, over steps of a tenth of a second or those of the file if they
are longer. The autocorrelation at a lag is the mean product of velocities so far apart, over their
mean square; that of a first order Markov process is exp(-lag / time constant).
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.files import read_poses
from sceneslam.experiments.laser import by_wheels, settings
from sceneslam.sources.carmen import Carmen
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.trajectory import Trajectory

STEP_S = 0.1
LAGS_S = 0.5, 1.0, 2.0, 5.0, 10.0


def read(path: Path) -> Trajectory:
    """Return a trajectory, of a log that of its wheels."""
    if path.suffix not in (".clf", ".log"):
        return read_poses(path)
    return by_wheels(list(Carmen(**{**settings("source/carmen.yaml"), "path": str(path)})))


def velocities(trajectory: Trajectory) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return stamps (N,) [s] and the base's twists (N, 6) [m/s, rad/s] from each to the next."""
    stamps_s = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    chosen = [0]
    for index, stamp_s in enumerate(stamps_s.tolist()):
        if stamp_s - stamps_s[chosen[-1]] >= STEP_S - 1e-6:
            chosen.append(index)
    if len(chosen) < 2:
        raise InputError(f"expected poses over {STEP_S:g} s or more, got {stamps_s[-1]:g} s")
    T, at_s = trajectory.T_world_base[chosen], stamps_s[chosen]
    motions = [se3.log(se3.inverse(a) @ b) for a, b in pairwise(T)]
    return at_s[:-1], np.stack(motions) / np.diff(at_s)[:, None]


def correlation(at_s: NDArray[np.float64], twists: NDArray[np.float64], lag_s: float) -> float:
    """Return the autocorrelation of velocities (N, K) at a lag."""
    later = np.searchsorted(at_s, at_s + lag_s - 0.5 * STEP_S)
    pairs = np.flatnonzero(later < len(at_s))
    pairs = pairs[np.abs(at_s[later[pairs]] - at_s[pairs] - lag_s) < 0.2 * lag_s + STEP_S]
    first, second = twists[pairs], twists[later[pairs]]
    size = np.sqrt((first**2).sum() * (second**2).sum())
    return float((first * second).sum() / max(size, 1e-12))


def main() -> None:
    """Print a row for each file's linear and angular velocity."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    files = [(path.parent.name, *velocities(read(path))) for path in map(Path, sys.argv[1:])]
    print("| file | velocity | " + " | ".join(f"{lag_s:g} s" for lag_s in LAGS_S) + " |")
    print("|---|---|" + "---|" * len(LAGS_S))
    for folder, at_s, twists in files:
        for name, part in (("linear", twists[:, :3]), ("angular", twists[:, 3:])):
            cells = []
            for lag_s in LAGS_S:
                rho = correlation(at_s, part, lag_s)
                lasts = f"{-lag_s / np.log(rho):.3g} s" if 0.0 < rho < 1.0 else "-"
                cells.append(f"{rho:.2f} ({lasts})")
            print(f"| {folder} | {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
