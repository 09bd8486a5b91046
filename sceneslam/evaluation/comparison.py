"""The distance between two runs over the same path (the paper's Fig. 8)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import root_mean_square
from sceneslam.evaluation.association import associate
from sceneslam.types import se3
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
    """Return the distance of poses within `max_gap_s` of each other, in the map of the first."""
    placed = placed_in_map(reference, trajectory, max_gap_s)
    matches = associate(trajectory, placed, max_gap_s)
    apart_m = trajectory.positions_m[matches.first] - placed.positions_m[matches.second]
    return Difference(
        stamps_ns=trajectory.stamps_ns[matches.first],
        differences_m=np.linalg.norm(apart_m, axis=1),
    )


def placed_in_map(trajectory: Trajectory, other: Trajectory, max_gap_s: float) -> Trajectory:
    """Return a trajectory in the map of another one over the same path.

    Two runs that begin together begin at the same pose, and are not aligned. A map that begins
    later, at the identity, is laid on the other at the first pose that both have.
    """
    matches = associate(trajectory, other, max_gap_s)
    T_own_base = trajectory.T_world_base[matches.first]
    T_map_base = other.T_world_base[matches.second]
    if not (
        _begins_within(matches.first, T_own_base, matches.second)
        or _begins_within(matches.second, T_map_base, matches.first)
    ):
        return trajectory
    T_map_own = T_map_base[0] @ se3.inverse(T_own_base[0])
    return replace(trajectory, T_world_base=T_map_own @ trajectory.T_world_base)


def _begins_within(
    matched: NDArray[np.int64], T_map_base: NDArray[np.float64], others: NDArray[np.int64]
) -> bool:
    """Tell whether a map begins, at the identity, while the other trajectory is under way."""
    is_later = len(matched) > 0 and matched[0] == 0 and others[0] > 0
    return is_later and np.allclose(T_map_base[0], np.eye(4), atol=1e-6)
