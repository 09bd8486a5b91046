"""Loop closure between submaps of any modules, by what a camera saw in both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.plan_loops import GAIN_MIN_M, TARGETS, MayClose, window_m
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar, se3
from sceneslam.types.se3 import Transform
from sceneslam.views.landmark_registration import recognize
from sceneslam.views.placed_views import PlacedViews, Sighting, are_covered
from sceneslam.views.view import PlacedView

_REACH_M = 2.0  # from so far away a place is still recognized


class ViewLoops:
    """Knows the views of all submaps so far."""

    def __init__(self, may_close: MayClose) -> None:
        self._may_close = may_close
        self._views = PlacedViews()
        self._owners: list[int] = []  # submap of each view
        self._placed: list[PlacedView] = []
        self._again: set[int] = set()  # views of the newest submap that show a known place

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
        poses = [
            T_map_node[owner] @ view.T_submap_base
            for owner, view in zip(self._owners, self._placed, strict=True)
        ]
        self._views.move(poses)
        known, reach_m = (
            np.reshape(poses, (-1, 4, 4)),
            self._reach_m(second, submaps, T_map_node, sigma),
        )
        is_compared = reach_m >= GAIN_MIN_M
        self._again = set()
        best: dict[int, tuple[int, Edge]] = {}  # matches and loop, by the earlier submap
        for row, view in enumerate(submaps[second].views):
            T_map_base = T_map_node[second] @ view.T_submap_base
            if _is_covered(T_map_base, known[~is_compared]):
                self._again.add(row)
                continue
            away_m = np.linalg.norm((known - T_map_base)[:, :3, 3], axis=1)
            among = np.flatnonzero(is_compared & (away_m <= reach_m + _REACH_M)).tolist()
            found = recognize(self._views, view.landmarks, among)
            if found is None:
                continue
            number, seen = found
            off_m = float(np.linalg.norm((seen.T_map_base - T_map_base)[:3, 3]))
            if off_m > reach_m[number]:
                continue
            if _is_covered(seen.T_map_base, known[number][None]):
                self._again.add(row)
            first = self._owners[number]
            if seen.matches > best.get(first, (0,))[0]:
                best[first] = seen.matches, self._edge(number, second, view, seen)
        by_matches = sorted(best.values(), key=lambda each: -each[0])
        return [loop for _, loop in by_matches[:TARGETS]]

    def keep(self, second: int, submap: Submap, T_map_node: Transform) -> tuple[PlacedView, ...]:
        """Add the views of the submap to which loops were searched, and return them.

        Those that show what an earlier one shows are left out: time spent in a known place adds
        none.
        """
        views = [view for row, view in enumerate(submap.views) if row not in self._again]
        for view in views:
            self._views.add(T_map_node @ view.T_submap_base, view.landmarks)
            self._owners.append(second)
            self._placed.append(view)
        return tuple(views)

    def _reach_m(
        self,
        second: int,
        submaps: Sequence[Submap],
        T_map_node: NDArray[np.float64],
        sigma: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return how far (V,) each view may be off where it is expected; 0 where no loop may be."""
        plane = planar.from_transforms(T_map_node)
        reach_m = {
            first: window_m(plane[first], plane[second], sigma[first])
            if self._may_close(first, second, submaps)
            else 0.0
            for first in dict.fromkeys(self._owners)
        }
        return np.array([reach_m[owner] for owner in self._owners])

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


def _is_covered(T_map_base: Transform, known: NDArray[np.float64]) -> bool:
    """Tell whether a view shows what one of the views at `known` poses (N, 4, 4) shows."""
    return bool(are_covered(T_map_base[None], known)[0])
