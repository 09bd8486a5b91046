"""Loop closure between submaps of any modules, by their floor plans."""

from __future__ import annotations

import numpy as np

from sceneslam.atlas.places.floor_plan import FloorPlan, join
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.submaps.loop_query import GAIN_MIN_M, NEIGHBOURS, TARGETS, LoopQuery, MayClose
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar
from sceneslam.types.planar import Planar

_TURN_MAX_RAD = 0.5 * np.pi  # a larger range: motions do not tell where a place is
_TARGET_MAX_M = 15.0  # from the middle of a target: a pose that jumps makes no huge plan
_KNOWN_MIN = 0.35  # share of a submap's walls, as two submaps may overlap partly
_CACHED = 8  # targets


class PlanLoops:
    """Finds a submap's floor plan in those around earlier ones."""

    def __init__(self, may_close: MayClose) -> None:
        self._may_close = may_close
        self._targets: dict[tuple[int, int], Recognizer] = {}

    def forget(self, count: int) -> None:
        """Forget all submaps but the first `count`."""
        self._targets = {ends: one for ends, one in self._targets.items() if ends[1] <= count}

    def loops_to(self, query: LoopQuery) -> list[Edge]:
        """Return the verified loops to a submap, around where the motions alone lead."""
        field: PlanField | None = None
        found = []
        for first in self._candidates(query):
            field, window = field or PlanField(query.submap.plan), query.window(first)
            match = self._target(first, query).recognize(field, window, known_min=_KNOWN_MIN)
            if match is None:
                continue
            off = planar.between(window.around, match.T_target_query)
            if np.hypot(off[0], off[1]) > window.half_m or abs(off[2]) > window.half_rad:
                continue
            found.append(
                Edge(
                    first=first,
                    second=query.second,
                    T_first_second=query.on_plane(first, match.T_target_query),
                    covariance=query.spatial(match.covariance),
                    kind=EdgeKind.LOOP,
                )
            )
        return found

    def _candidates(self, query: LoopQuery) -> list[int]:
        """Return the nearest submaps that may overlap; no two of them are neighbours."""
        near: list[tuple[float, int]] = []
        second, submaps, plan = query.second, query.submaps, query.submap.plan
        if not len(plan):
            return []
        earlier = np.arange(second - 1)
        reach_m = query.reach_m(earlier)
        is_near = (reach_m >= GAIN_MIN_M) & (query.turn_rad(earlier) <= _TURN_MAX_RAD)
        is_near &= query.is_on_storey(earlier)
        for first in np.flatnonzero(is_near).tolist():
            if not (self._may_close(first, second, submaps) and len(submaps[first].plan)):
                continue
            around = planar.between(query.plane[first], query.plane[second])
            if _gap_m(submaps[first].plan, plan, around) <= reach_m[first]:
                near.append((float(np.hypot(*around[:2])), first))
        chosen: list[int] = []
        for _, first in sorted(near):
            if len(chosen) < TARGETS and all(abs(first - c) > NEIGHBOURS for c in chosen):
                chosen.append(first)
        return chosen

    def _target(self, first: int, query: LoopQuery) -> Recognizer:
        """Return a recognizer for the plan around `first`, of its session, older than the query."""
        end = min(first + NEIGHBOURS + 1, query.second)
        if (first, end) not in self._targets:
            while len(self._targets) >= _CACHED:
                del self._targets[next(iter(self._targets))]
            own, start = query.submaps[first], max(first - NEIGHBOURS, 0)
            near = [planar.between(query.plane[first], T) for T in query.plane[start:end]]
            placed = [
                (T, one.plan)
                for T, one in zip(near, query.submaps[start:end], strict=True)
                if (one.run, one.session) == (own.run, own.session)
                and np.hypot(T[0], T[1]) <= _TARGET_MAX_M
            ]
            self._targets[first, end] = Recognizer(PlanField(join(placed)))
        return self._targets[first, end]


def _gap_m(first: FloorPlan, second: FloorPlan, T_first_second: Planar) -> float:
    """Return the distance [m] of two plans' bounding boxes, 0 or less if they overlap."""
    a = first.points.astype(np.float64)
    b = planar.apply(T_first_second, second.points.astype(np.float64))
    gaps = np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))
    return float(gaps.max())
