"""Loop closure between submaps of any modules, by what a camera saw in both."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.loop_query import GAIN_MIN_M, TARGETS, LoopQuery, MayClose
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import se3
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
        self._owned: list[tuple[int, PlacedView]] = []  # the same, each with its submap

    def forget(self, count: int) -> None:
        """Forget all submaps but the first `count`."""
        kept = bisect_left(self._owned, count, key=lambda one: one[0])
        self._views.cut(kept)
        del self._owned[kept:]

    def loops_to(self, query: LoopQuery) -> tuple[list[Edge], tuple[PlacedView, ...]]:
        """Return the loops to a submap, around where the motions alone lead, and its views to keep.

        Views that show what an earlier one shows are left out: time spent in a known place adds
        none.
        """
        self.forget(query.second)  # what a search that was interrupted left
        poses = [query.T_run_node[owner] @ view.T_submap_cam for owner, view in self._owned]
        self._views.move(poses)
        known, reach_m = np.reshape(poses, (-1, 4, 4)), self._reach_m(query)
        settled = np.flatnonzero(reach_m < GAIN_MIN_M)  # with these, views are not compared
        # Matches and loop, by the earlier submap; in another piece every view counts.
        best: dict[tuple[int, int], tuple[int, Edge]] = {}
        kept: list[tuple[Transform, PlacedView]] = []
        for view in query.submap.views:
            T_run_cam = query.T_run_node[query.second] @ view.T_submap_cam
            if self._covers(settled, T_run_cam, view):
                continue
            found = self._recognized(view, T_run_cam, known, reach_m)
            if found is None or not self._covers(found[:1], found[1].T_map_cam, view):
                kept.append((T_run_cam, view))
            if found is None:
                continue
            number, seen = found
            first = self._owned[number][0]
            place = first, view.stamp_ns if first < query.start else 0
            if seen.matches > best.get(place, (0,))[0]:
                best[place] = seen.matches, self._edge(number, query.second, view, seen)
        for T_run_cam, view in kept:
            self._views.add(T_run_cam, view.landmarks)
            self._owned.append((query.second, view))
        by_matches = sorted(best.values(), key=lambda each: -each[0])
        return [loop for _, loop in by_matches[:TARGETS]], tuple(view for _, view in kept)

    def _reach_m(self, query: LoopQuery) -> NDArray[np.float64]:
        """Return how far (V,) each view may be off where it is expected; 0 where no loop may be."""
        drifted_m = query.reach_m(np.arange(query.second))
        reach_m = {
            first: float(drifted_m[first])
            if self._may_close(first, query.second, query.submaps)
            else 0.0
            for first in dict.fromkeys(owner for owner, _ in self._owned)
        }
        return np.array([reach_m[owner] for owner, _ in self._owned])

    def _covers(self, numbers: Iterable[int], T_run_cam: Transform, view: PlacedView) -> bool:
        """Tell whether one of the views with these numbers shows as much as a new one."""
        known = [self._views[number] for number in numbers]
        return bool(are_covered([(T_run_cam, view.landmarks)], known)[0])

    def _recognized(
        self,
        view: PlacedView,
        T_run_cam: Transform,
        known: NDArray[np.float64],
        reach_m: NDArray[np.float64],
    ) -> tuple[int, Sighting] | None:
        """Return which of the `known` poses (V, 4, 4) a view shows, and from where, if any."""
        away_m = np.linalg.norm((known - T_run_cam)[:, :3, 3], axis=1)
        is_near = (reach_m >= GAIN_MIN_M) & (away_m <= reach_m + _REACH_M)
        found = recognize(self._views, view.landmarks, np.flatnonzero(is_near).tolist())
        if found is None:
            return None
        number, seen = found
        off_m = float(np.linalg.norm((seen.T_map_cam - T_run_cam)[:3, 3]))
        return found if off_m <= reach_m[number] else None

    def _edge(self, number: int, second: int, view: PlacedView, seen: Sighting) -> Edge:
        """Return the loop to a submap by one of its views, which shows what view `number` shows."""
        first, known = self._owned[number]
        T_known_view = se3.inverse(self._views[number][0]) @ seen.T_map_cam
        return Edge(
            first=first,
            second=second,
            T_first_second=known.T_submap_cam @ T_known_view @ se3.inverse(view.T_submap_cam),
            covariance=se3.carried(seen.covariance, view.T_submap_cam),
            kind=EdgeKind.LOOP,
        )
