"""How far a path drifts between two submaps: what the errors of its motions add up to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.submap import LEAST, LENGTH_M
from sceneslam.atlas.uncertainty import MAPPED, drifted
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar

# Of the summed variances of a map: (1 + r) / (1 - r), as errors of successive submaps correlate by
# r = 0.6 (0.53 on Intel, 0.61 on ACES, -0.01 on MIT CSAIL). What modules report needs none.
_CORRELATED = (1.0 + 0.6) / (1.0 - 0.6)
_SUBMAP = drifted(MAPPED, np.array([LENGTH_M, 0.0])) + np.diag(LEAST**2)
_MAPPED = np.diag(planar.planar_covariance(_SUBMAP))  # of a map's motion from submap to submap

Indices = int | NDArray[np.int64]  # of submaps


def summed(before: NDArray[np.float64], motion: Edge) -> NDArray[np.float64]:
    """Return the sums (2, 3) after a motion: of systematic deviations, and of random variances.

    Both of x, y [m], and yaw [rad]. Those of wheels and of velocity are systematic, those of a map
    are random.
    """
    variances = np.diag(planar.planar_covariance(motion.covariance))
    after = before.copy()
    if motion.kind is EdgeKind.BRIDGE:
        after[0] += np.sqrt(variances)
    else:
        mapped = np.minimum(variances, _MAPPED)
        after[1] += _CORRELATED * mapped + (variances - mapped)
    return after


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PathDrift:
    """The drift of the path to each submap."""

    sums: NDArray[np.float64]  # (N, 2, 3), as `summed` has them

    @classmethod
    def of(cls, rows: Sequence[NDArray[np.float64]]) -> PathDrift:
        """Return the drift of a chain, from its sums (2, 3)."""
        return cls(sums=np.array(rows).reshape(-1, 2, 3))

    @classmethod
    def along(cls, motions: Sequence[Edge], count: int) -> PathDrift:
        """Return that of `count` submaps of any runs, by the motions from one to the next.

        Each run begins with no drift; between two runs, differences tell little.
        """
        rows = np.zeros((count, 2, 3))
        for motion in sorted(motions, key=lambda edge: edge.second):
            if not motion.is_loop and motion.second == motion.first + 1:
                rows[motion.second] = summed(rows[motion.first], motion)
        return cls(sums=rows)

    def after(self, others: PathDrift) -> PathDrift:
        """Return the drift of other submaps, and then of these."""
        return PathDrift(sums=np.concatenate([others.sums, self.sums]))

    def deviations(self, *ends: Indices) -> NDArray[np.float64]:
        """Return the standard deviations (..., 3) [m, m, rad] of all paths between two ends."""
        off = np.zeros((2, 3))
        for first, second in zip(ends[::2], ends[1::2], strict=True):
            off = off + np.abs(self.sums[second] - self.sums[first])
        return np.asarray(off[..., 0, :] + np.sqrt(off[..., 1, :]))

    def swing_m(
        self, xy_m: NDArray[np.float64], first: Indices, second: int
    ) -> NDArray[np.float64]:
        """Return how far [m] (...) the headings' errors on the way move a submap.

        Of nodes at `xy_m` (N, 2), from earlier ones to it. A random error moves it by its distance
        from where that arose; systematic ones turn half of the way between the two.
        """
        away2 = ((xy_m - xy_m[second]) ** 2).sum(axis=1)
        moved2 = (np.diff(self.sums[:, 1, 2], prepend=0.0) * away2).cumsum()
        turned = np.abs(self.sums[second, 0, 2] - self.sums[first, 0, 2])
        random_m = np.sqrt(moved2[second] - moved2[first])
        return np.asarray(random_m + 0.5 * np.sqrt(away2[first]) * turned)
