"""The pose graph's correction of a run's poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correction:
    """A correction of the map at each node of a run, ordered by stamp."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T_new_old: NDArray[np.float64]  # (N, 4, 4)

    @classmethod
    def none(cls) -> Correction:
        """Return the correction that leaves all poses unchanged, bit by bit."""
        return cls(stamps_ns=np.zeros(0, np.int64), T_new_old=np.zeros((0, 4, 4)))

    def apply(
        self, stamps_ns: NDArray[np.int64], T_map_base: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the corrected poses (M, 4, 4); between two nodes it interpolates over time."""
        if not len(self.stamps_ns):
            return T_map_base
        newest = len(self.stamps_ns) - 1
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), min(1, newest), newest)
        before = np.maximum(after - 1, 0)
        span_ns = np.maximum(self.stamps_ns[after] - self.stamps_ns[before], 1)
        shares = np.clip((stamps_ns - self.stamps_ns[before]) / span_ns, 0.0, 1.0)
        moved = np.array(T_map_base)
        for row, share in enumerate(shares.tolist()):
            first, second = (
                self.T_new_old[node[row]] @ T_map_base[row] for node in (before, after)
            )
            moved[row] = se3.interpolate(first, second, share)
        return moved
