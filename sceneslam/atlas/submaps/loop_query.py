"""Where loops to a submap are searched: around where the motions alone lead, by what they drift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.plan_search import SearchWindow
from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.graph import on_floor
from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.atlas.submaps.uprights import by_hand, floor_normal, mount, tilt, usual_up
from sceneslam.graphs.edge import Edge
from sceneslam.types import planar, se3
from sceneslam.types.planar import Matrix, Planar
from sceneslam.types.se3 import Transform, Vector

SIGMAS = 3.0  # of the drift: search range
GAIN_MIN_M = SIGMAS * 0.02  # a smaller range: recognition cannot improve on so little drift
NEIGHBOURS = 2  # neighbouring submaps on either side in a target
_STOREY_M = 1.2  # half of the lowest storey: less is a module's drift in height
_UP = np.array([0.0, 0.0, 1.0])
TARGETS = 3  # per submap: three loops to different places outvote a wrong one

# Tells whether a loop may lead from a submap to a later one.
MayClose = Callable[[int, int, Sequence[Submap]], bool]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopQuery:
    """A submap of a run, and where the motions alone lead.

    Around a solution with a wrong loop, others that agree with it would be found, and not the right
    ones.
    """

    second: int  # index of the submap
    submaps: Sequence[Submap]
    T_run_node: NDArray[np.float64]  # (N, 4, 4)
    plane: NDArray[np.float64]  # (N, 3), the nodes in the plane [m, m, rad]
    motions: Sequence[Edge]  # from each submap to the next
    drift: PathDrift
    floor_normal: Vector | None  # (3,), in base; None: base is carried by hand
    starts: Sequence[int]  # with these a piece begins: the motion to them is hardly known

    @classmethod
    def of(cls, chain: Chain, second: int) -> LoopQuery:
        """Return the query for a submap of a chain."""
        nodes = np.array(chain.T_run_node)
        return cls(
            second=second,
            submaps=chain.submaps,
            T_run_node=nodes,
            plane=planar.from_transforms(chain.T_run_node),
            motions=chain.motions,
            drift=PathDrift.of(chain.drift),
            floor_normal=floor_normal(chain.motions, nodes, chain.submaps),
            starts=chain.starts,
        )

    def to(self, second: int) -> LoopQuery:
        """Return the query for another submap of the same run."""
        return replace(self, second=second)

    @property
    def submap(self) -> Submap:
        """Return the submap to which loops are searched."""
        return self.submaps[self.second]

    @property
    def start(self) -> int:
        """Return the submap with which the piece of `second` begins."""
        return max(start for start in self.starts if start <= self.second)

    def reach_m(self, first: int | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return how far [m] (...) the submap may be off, as seen from earlier ones (...)."""
        x_m, y_m, _ = np.moveaxis(self.drift.deviations(first, self.second), -1, 0)
        swung_m = self.drift.swing_m(self.plane[:, :2], first, self.second)
        return np.asarray(SIGMAS * np.hypot(np.maximum(x_m, y_m), swung_m))

    def turn_rad(self, first: int | NDArray[np.int64]) -> NDArray[np.float64]:
        """Return by how much [rad] (...) the submap may be turned, as seen from earlier ones."""
        return np.asarray(SIGMAS * self.drift.deviations(first, self.second)[..., 2])

    def is_on_storey(self, first: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which earlier submaps (N,) may lie on the same storey, by the motions and drift."""
        normal = _UP if self.floor_normal is None else self.floor_normal
        up = usual_up(self.submaps, self.T_run_node, normal)
        climbed_m = (self.T_run_node[first, :3, 3] - self.T_run_node[self.second, :3, 3]) @ up
        return np.abs(climbed_m) <= np.maximum(self.reach_m(first), _STOREY_M)

    def on_plane(self, first: int, T_first_second: Planar) -> Transform:
        """Return the motion (4, 4) from an earlier submap, of which the part in the plane is given.

        Height and tilt are as the motions alone say; on a floor they do not change.
        """
        lies, found = self.plane[self.second], planar.compose(self.plane[first], T_first_second)
        T_found_lies = planar.to_transform(found) @ se3.inverse(planar.to_transform(lies))
        T_run_second = T_found_lies @ self.T_run_node[self.second]
        T_base_second = np.asarray(se3.inverse(self.T_run_node[first]) @ T_run_second)
        if self.floor_normal is None:
            return T_base_second
        T_level_base = mount(self.floor_normal)
        T_base_level = se3.inverse(T_level_base)
        flat = planar.from_transform(T_level_base @ T_base_second @ T_base_level)
        return np.asarray(T_base_level @ planar.to_transform(flat) @ T_level_base)

    @property
    def T_level_second(self) -> Transform:
        """Return the submap's roll and pitch (4, 4) if base is carried by hand; none on a floor."""
        if self.floor_normal is not None:
            return se3.identity()
        return tilt(self.T_run_node, self.submaps, self.second)

    def spatial(self, covariance: Matrix) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a motion to the submap from that in the plane (3, 3)."""
        if self.floor_normal is not None:
            return on_floor(covariance)
        return by_hand(covariance, self.T_level_second)

    def window(self, first: int) -> SearchWindow:
        """Return where the submap may lie in the frame of an earlier one."""
        return SearchWindow(
            around=planar.between(self.plane[first], self.plane[self.second]),
            half_m=float(self.reach_m(first)),
            half_rad=float(self.turn_rad(first)),
        )
