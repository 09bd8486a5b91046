"""The distance between two runs over the same path (the paper's Fig. 8)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import root_mean_square
from sceneslam.evaluation.association import associate
from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Difference:
    """Distance between two trajectories where both have a pose."""

    stamps_ns: NDArray[np.int64]  # (N,)
    differences_m: NDArray[np.float64]  # (N,)

    @property
    def max_m(self) -> float:
        """Return the largest distance [m], NaN when nothing matched."""
        return float(self.differences_m.max()) if len(self.differences_m) else float("nan")

    @property
    def rms_m(self) -> float:
        """Return the root mean square distance [m], NaN when nothing matched."""
        return root_mean_square(self.differences_m)


def compare(trajectory: Trajectory, reference: Trajectory, max_gap_s: float) -> Difference:
    """Return the distance of poses within `max_gap_s` of each other, directly in `map`.

    There is no alignment: both runs start at the identity at the same place.
    """
    matches = associate(trajectory, reference, max_gap_s)
    offset_m = trajectory.positions_m[matches.first] - reference.positions_m[matches.second]
    return Difference(
        stamps_ns=trajectory.stamps_ns[matches.first],
        differences_m=np.linalg.norm(offset_m, axis=1),
    )
