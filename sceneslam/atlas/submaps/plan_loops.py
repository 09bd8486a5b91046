"""Loop closure between submaps of any modules, by their floor plans."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import FloorPlan, join
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.plan_search import SearchWindow
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.submaps.graph import on_floor
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar
from sceneslam.types.planar import Planar

SIGMAS = 3.0  # of the drift: search range around the graph's estimate
GAIN_MIN_M = SIGMAS * 0.02  # a smaller range: recognition cannot improve on so little drift
_HALF_MAX_M = 15.0  # largest search range
NEIGHBOURS = 2  # neighbouring submaps on either side in a target
TARGETS = 3  # per submap: three loops to different places outvote a wrong one
_KNOWN_MIN = 0.35  # share of a submap's walls, as two submaps may overlap partly
_CACHED = 8  # targets

# Tells whether a loop may lead from a submap to a later one.
MayClose = Callable[[int, int, Sequence[Submap]], bool]


class PlanLoops:
    """Finds a submap's floor plan in those around earlier ones."""

    def __init__(self, may_close: MayClose) -> None:
        self._may_close = may_close
        self._targets: dict[tuple[int, int], Recognizer] = {}

    def forget(self, count: int) -> None:
        """Forget all submaps but the first `count`."""
        self._targets = {ends: one for ends, one in self._targets.items() if ends[1] <= count}

    def loops_to(
        self,
        second: int,
        submaps: Sequence[Submap],
        T_map_node: NDArray[np.float64],
        sigma: NDArray[np.float64],
    ) -> list[Edge]:
        """Return the verified loops from earlier submaps to one, near the graph's estimate.

        `T_map_node` (N, 3) are the estimated nodes [m, m, rad], `sigma` (N, 3) the standard
        deviations [m, m, rad] of the motion from each of them to this one.
        """
        query: PlanField | None = None
        found = []
        for first in self._candidates(second, submaps, T_map_node, sigma):
            query = query or PlanField(submaps[second].plan)
            window = _window(T_map_node[first], T_map_node[second], sigma[first])
            target = self._target(first, second, submaps, T_map_node)
            match = target.recognize(query, window, known_min=_KNOWN_MIN)
            if match is None:
                continue
            off = planar.between(window.around, match.T_target_query)
            if np.hypot(off[0], off[1]) > window.half_m or abs(off[2]) > window.half_rad:
                continue
            found.append(
                Edge(
                    first=first,
                    second=second,
                    T_first_second=planar.to_transform(match.T_target_query),
                    covariance=on_floor(match.covariance),
                    kind=EdgeKind.LOOP,
                )
            )
        return found

    def _candidates(
        self,
        second: int,
        submaps: Sequence[Submap],
        T_map_node: NDArray[np.float64],
        sigma: NDArray[np.float64],
    ) -> list[int]:
        """Return the nearest submaps that may overlap; no two of them are neighbours."""
        near: list[tuple[float, int]] = []
        if not len(submaps[second].plan):
            return []
        for first in range(second - 1):
            if not (self._may_close(first, second, submaps) and len(submaps[first].plan)):
                continue
            window = _window(T_map_node[first], T_map_node[second], sigma[first])
            if not GAIN_MIN_M <= window.half_m <= _HALF_MAX_M:
                continue
            gap_m = _gap_m(submaps[first].plan, submaps[second].plan, window.around)
            if gap_m <= window.half_m:
                near.append((float(np.hypot(*window.around[:2])), first))
        chosen: list[int] = []
        for _, first in sorted(near):
            if len(chosen) < TARGETS and all(abs(first - c) > NEIGHBOURS for c in chosen):
                chosen.append(first)
        return chosen

    def _target(
        self,
        first: int,
        second: int,
        submaps: Sequence[Submap],
        T_map_node: NDArray[np.float64],
    ) -> Recognizer:
        """Return a recognizer for the plan around `first`, of its session, older than `second`."""
        end = min(first + NEIGHBOURS + 1, second)
        if (first, end) not in self._targets:
            while len(self._targets) >= _CACHED:
                del self._targets[next(iter(self._targets))]
            own = submaps[first]
            around = range(max(first - NEIGHBOURS, 0), end)
            placed = [
                (planar.between(T_map_node[first], T_map_node[index]), submaps[index].plan)
                for index in around
                if (submaps[index].run, submaps[index].session) == (own.run, own.session)
            ]
            self._targets[first, end] = Recognizer(PlanField(join(placed)))
        return self._targets[first, end]


def window_m(T_map_first: Planar, T_map_second: Planar, sigma: NDArray[np.float64]) -> float:
    """Return how far [m] a motion with deviations `sigma` (3,) may be off."""
    lever_m = 0.5 * np.hypot(*(T_map_second - T_map_first)[:2])
    return SIGMAS * float(max(sigma[0], sigma[1]) + lever_m * sigma[2])


def _window(T_map_first: Planar, T_map_second: Planar, sigma: NDArray[np.float64]) -> SearchWindow:
    return SearchWindow(
        around=planar.between(T_map_first, T_map_second),
        half_m=window_m(T_map_first, T_map_second, sigma),
        half_rad=SIGMAS * float(sigma[2]),
    )


def _gap_m(first: FloorPlan, second: FloorPlan, T_first_second: Planar) -> float:
    """Return the distance [m] of two plans' bounding boxes, 0 or less if they overlap."""
    a = first.points.astype(np.float64)
    b = planar.apply(T_first_second, second.points.astype(np.float64))
    gaps = np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))
    return float(gaps.max())
