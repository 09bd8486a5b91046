"""The edge of a pose graph: a measured motion between two nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform


class EdgeKind(IntEnum):
    """The source of an edge."""

    MOTION = 0  # by one module
    BRIDGE = 1  # by wheels, gyro or constant velocity
    HANDOVER = 2  # from one module to the next, over observations that both processed
    LOOP = 3  # a revisited place


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """A measured motion between two nodes."""

    first: int
    second: int
    T_first_second: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order [m, rad], axes of second
    kind: EdgeKind = EdgeKind.MOTION

    @property
    def is_loop(self) -> bool:
        """Tell whether a place was recognized, which may be wrong."""
        return self.kind is EdgeKind.LOOP

    def shifted(self, by: int) -> Edge:
        """Return the edge with its node numbers increased by `by`."""
        return replace(self, first=self.first + by, second=self.second + by)

    def turned(self) -> Edge:
        """Return the measurement inverted, from the second node to the first."""
        return replace(
            self,
            first=self.second,
            second=self.first,
            T_first_second=se3.inverse(self.T_first_second),
            covariance=se3.carried(self.covariance, self.T_first_second),
        )

    def then(self, after: Edge) -> Edge:
        """Return the composition of this edge and one that begins at its end."""
        carried = se3.carried(self.covariance, se3.inverse(after.T_first_second))
        return Edge(
            first=self.first,
            second=after.second,
            T_first_second=self.T_first_second @ after.T_first_second,
            covariance=carried + after.covariance,
            kind=max(self.kind, after.kind),
        )
