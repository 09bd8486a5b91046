"""The pose graph's correction of a run's poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

_FELT_M, _FELT_RAD = 0.01, 0.005  # smaller changes are within the noise of a pose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correction:
    """A correction of the map at each node of a run, ordered by stamp."""

    stamps_ns: NDArray[np.int64]  # (N,)
    T_new_old: NDArray[np.float64]  # (N, 4, 4)

    @classmethod
    def none(cls) -> Correction:
        """Return the correction that leaves all poses unchanged, bit by bit."""
        return cls(stamps_ns=np.zeros(0, np.int64), T_new_old=np.zeros((0, 4, 4)))

    def cut(self, stamp_ns: int) -> Correction:
        """Return the correction at the nodes before a stamp; the first node always stays."""
        kept = max(int(np.searchsorted(self.stamps_ns, stamp_ns)), 1)
        return Correction(stamps_ns=self.stamps_ns[:kept], T_new_old=self.T_new_old[:kept])

    def changes(self, before: Correction) -> Correction:
        """Return the nodes that differ by 1 cm or 0.3 degrees from those of another correction.

        And the newest one, whatever it is. Nodes that only the other has count with this one's
        value there, as `updated` drops none.
        """
        gone_ns = np.setdiff1d(before.stamps_ns, self.stamps_ns)
        T_gone = self.apply(gone_ns, np.tile(se3.identity(), (len(gone_ns), 1, 1)))
        whole = self.updated(Correction(stamps_ns=gone_ns, T_new_old=T_gone))
        keep = np.ones(len(whole.stamps_ns), bool)
        _, rows, known = np.intersect1d(
            whole.stamps_ns[:-1], before.stamps_ns, assume_unique=True, return_indices=True
        )
        off = se3.inverse(before.T_new_old[known]) @ whole.T_new_old[rows]
        is_far = np.linalg.norm(off[:, :3, 3], axis=1) > _FELT_M
        keep[rows] = is_far | (se3.rotation_angle_rad(off) > _FELT_RAD)
        return Correction(stamps_ns=whole.stamps_ns[keep], T_new_old=whole.T_new_old[keep])

    def updated(self, changes: Correction) -> Correction:
        """Return the correction with other values at the nodes of `changes`."""
        kept = ~np.isin(self.stamps_ns, changes.stamps_ns)
        stamps_ns = np.concatenate([self.stamps_ns[kept], changes.stamps_ns])
        order = np.argsort(stamps_ns, kind="stable")
        T_new_old = np.concatenate([self.T_new_old[kept], changes.T_new_old])
        return Correction(stamps_ns=stamps_ns[order], T_new_old=T_new_old[order])

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
        first, second = (self.T_new_old[nodes] @ T_map_base for nodes in (before, after))
        return se3.interpolate(first, second, shares)

    def moved(
        self, was: Correction, stamps_ns: NDArray[np.int64], T_map_base: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return poses (M, 4, 4) that `was` corrected, as this one does.

        It may be moved any number of times: what one correction adds the next takes away.
        """
        still = np.tile(se3.identity(), (len(stamps_ns), 1, 1))
        T_now_run, T_was_run = (one.apply(stamps_ns, still) for one in (self, was))
        return np.asarray(T_now_run @ se3.inverse(T_was_run) @ T_map_base)
