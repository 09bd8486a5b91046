"""Loop closure between submaps of any modules, by what a camera saw in both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.plan_loops import GAIN_MIN_M, MayClose, window_m
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar, se3
from sceneslam.types.se3 import Transform
from sceneslam.views.landmark_registration import recognize
from sceneslam.views.placed_views import PlacedViews, Sighting
from sceneslam.views.view import PlacedView

_REACH_M = 2.0  # from so far away a place is still recognized


class ViewLoops:
    """Knows the views of all submaps so far."""

    def __init__(self, may_close: MayClose) -> None:
        self._may_close = may_close
        self._views = PlacedViews()
        self._owners: list[int] = []  # submap of each view
        self._placed: list[PlacedView] = []

    def forget(self, count: int) -> None:
        """Forget all submaps but the first `count`."""
        kept = int(np.searchsorted(self._owners, count))
        self._views.cut(kept)
        del self._owners[kept:], self._placed[kept:]

    def loops_to(
        self,
        second: int,
        submaps: Sequence[Submap],
        T_map_node: NDArray[np.float64],
        sigma: NDArray[np.float64],
    ) -> list[Edge]:
        """Return the loops from earlier submaps to one, near the graph's estimate.

        `T_map_node` (N, 4, 4) are the estimated nodes, `sigma` (N, 3) the standard deviations
        [m, m, rad] of the motion from each of them to this one.
        """
        plane = planar.from_transforms(T_map_node)
        reach_m = {
            first: window_m(plane[first], plane[second], sigma[first])
            for first in dict.fromkeys(self._owners)
            if self._may_close(first, second, submaps)
        }
        self._views.move(
            [
                T_map_node[owner] @ view.T_submap_base
                for owner, view in zip(self._owners, self._placed, strict=True)
            ]
        )
        best: dict[int, tuple[int, Edge]] = {}  # matches and loop, by the earlier submap
        for view in submaps[second].views:
            T_map_base = T_map_node[second] @ view.T_submap_base
            found = recognize(self._views, view.landmarks, self._within(T_map_base, reach_m))
            if found is None:
                continue
            number, seen = found
            first = self._owners[number]
            off_m = float(np.linalg.norm((seen.T_map_base - T_map_base)[:3, 3]))
            if off_m <= reach_m[first] and seen.matches > best.get(first, (0,))[0]:
                best[first] = seen.matches, self._edge(number, second, view, seen)
        for view in submaps[second].views:
            self._views.add(T_map_node[second] @ view.T_submap_base, view.landmarks)
            self._owners.append(second)
            self._placed.append(view)
        return [loop for _, loop in best.values()]

    def _within(self, T_map_base: Transform, reach_m: Mapping[int, float]) -> list[int]:
        """Return the views of submaps that the robot may be at, if a loop improves its pose."""
        found = []
        for number, owner in enumerate(self._owners):
            half_m = reach_m.get(owner, 0.0)
            away_m = float(np.linalg.norm((self._views[number][0] - T_map_base)[:3, 3]))
            if half_m >= GAIN_MIN_M and away_m <= half_m + _REACH_M:
                found.append(number)
        return found

    def _edge(self, number: int, second: int, view: PlacedView, seen: Sighting) -> Edge:
        """Return the loop to a submap by one of its views, which shows what view `number` shows."""
        T_first_known = self._placed[number].T_submap_base
        T_known_view = se3.inverse(self._views[number][0]) @ seen.T_map_base
        return Edge(
            first=self._owners[number],
            second=second,
            T_first_second=T_first_known @ T_known_view @ se3.inverse(view.T_submap_base),
            covariance=se3.carried(seen.covariance, view.T_submap_base),
            kind=EdgeKind.LOOP,
        )
