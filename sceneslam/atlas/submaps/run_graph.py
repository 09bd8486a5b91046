"""The graph of a run and of the map that it was located in: its loops, and its solution."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.localizer import Fix
from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.graph import (
    Agreement,
    Solved,
    consistent,
    fits,
    settle,
    solve,
)
from sceneslam.atlas.submaps.loop_query import NEIGHBOURS, LoopQuery
from sceneslam.atlas.submaps.own_loops import Path, closed_loops
from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.atlas.submaps.piece_loops import PieceLoops
from sceneslam.atlas.submaps.plan_loops import PlanLoops
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.atlas.submaps.uprights import straightened, uprights
from sceneslam.atlas.submaps.view_loops import ViewLoops
from sceneslam.graphs.edge import Edge
from sceneslam.types import se3
from sceneslam.types.maps import MapLayers
from sceneslam.types.se3 import Transform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolvedRun:
    """The run's nodes after optimisation, and the accepted loops."""

    T_map_node: NDArray[np.float64]  # (N, 4, 4), as many as the run has submaps
    loops: tuple[Edge, ...]  # nodes of the loaded map are counted first
    own_loops: tuple[Edge, ...] = ()  # of modules, that were used too
    T_map_loaded: NDArray[np.float64] | None = None  # nodes (L, 4, 4) of the loaded map, if moved

    def cut(self, count: int, loaded: int) -> SolvedRun:
        """Return the solution of the first `count` nodes, counted after those that were loaded."""
        return SolvedRun(
            T_map_node=self.T_map_node[:count],
            loops=tuple(loop for loop in self.loops if loop.second < loaded + count),
        )


class RunGraph:
    """Joins the submaps of a run, while it goes on and at its end, there with a loaded map."""

    def __init__(
        self, loaded: SavedMap, is_closed: Callable[[int], bool], *, moves_loaded: bool = False
    ) -> None:
        """Begin without submaps; `is_closed` tells in which sessions modules close loops.

        `moves_loaded`: the loaded map is optimised, too, if the run is found in it.
        """
        self._loaded, self._count = loaded, len(loaded.submaps)
        self._is_closed, self._moves_loaded = is_closed, moves_loaded
        self._plans, self._views = PlanLoops(self._may_close), ViewLoops(self._may_close)
        self._pieces = PieceLoops()
        self._seen = self._planned = 0  # submaps to which loops were searched, by views and plans
        self._found = Agreement()  # loops between submaps of the run
        self._agreed: list[Edge] = []  # of these, used in the last solution
        self._accepted: list[Edge] = []  # of these, not rejected by it
        self._T_map_node = np.zeros((0, 4, 4))  # the last solution
        self._starts: frozenset[int] = frozenset()  # submaps with which a piece begins

    def forget(self, count: int) -> None:
        """Forget all submaps but the first `count`: others took their place."""
        if count >= len(self._T_map_node):
            return
        self._seen, self._planned = min(self._seen, count), min(self._planned, count)
        self._T_map_node = self._T_map_node[:count]
        self._found.cut(count)
        self._accepted = [edge for edge in self._accepted if edge.second < count]
        self._plans.forget(count)
        self._pieces.forget(count)
        self._views.forget(count)

    def extend(self, chain: Chain, *, is_level: bool) -> SolvedRun:
        """Look for loops to the submaps of a run that are new; solve without the loaded map."""
        self._place(chain)
        self._search(chain, is_level=is_level)
        agreeing = self._believed([self._found.loops[index] for index in self._found.largest()])
        if agreeing != self._agreed:
            # What did not fit before is left out until it does, or to the end of the run.
            used = [edge for edge in agreeing if self._is_used(edge)]
            # Without loops nodes are where the motions lead.
            start = self._T_map_node if used else np.array(chain.T_run_node)
            solved = Solved(T_map_node=start, accepted=[])
            if used:
                ups = uprights(straightened(chain), start, range(len(chain)))
                solved = settle(start, chain.ties, used, ups)
            self._agreed, self._T_map_node = agreeing, solved.T_map_node
            self._accepted = [used[index] for index in solved.accepted]
        loops = tuple(edge.shifted(self._count) for edge in self._accepted)
        return SolvedRun(T_map_node=self._T_map_node, loops=loops)

    def finish(
        self,
        chain: Chain,
        T_map_node: NDArray[np.float64],
        path: Path,
        maps: Sequence[MapLayers],
        fixes: Sequence[Fix],
        *,
        is_level: bool,
    ) -> SolvedRun:
        """Solve the whole graph; `T_map_node` (N, 4, 4) are the run's nodes by its motions alone.

        `path` are the poses as revised by the modules, `maps` theirs, with their own loops, `fixes`
        the places where the run was located in the loaded map.
        """
        count, ends = self._count, _Ends(chain, path)
        own_loops = [edge.shifted(count) for edge in ends.edges_of(closed_loops(maps))]
        drift = PathDrift.of(chain.drift).after(PathDrift.along(self._loaded.edges, count))
        self._place(chain)
        self._search(chain, is_level=is_level)
        # The motions alone tell what agrees. No cycle tells it of a place of the loaded map and a
        # loop of the run.
        moved = np.concatenate([self._loaded.T_map_node, T_map_node])
        places = _agreeing(_places(self._loaded, fixes, ends), chain, moved, drift)
        loops = [edge.shifted(count) for edge in self._found.loops]
        agreeing = [self._found.loops[index] for index in consistent(loops, moved, drift)]
        loops = [edge.shifted(count) for edge in self._believed(agreeing)]
        nodes = np.concatenate([self._loaded.T_map_node, ends.placed(fixes, T_map_node)])
        around = self._loaded.nodes() if places and self._moves_loaded else []
        moving = self._loaded.moving(around)
        submaps = [*self._loaded.submaps, *straightened(chain)]
        solved = solve(
            nodes,
            [*moving.motions, *(edge.shifted(count) for edge in chain.ties), *own_loops],
            loops,
            fixed=moving.fixed,
            loose=[*moving.loose, count],
            places=[*moving.loops, *places],
            uprights=uprights(submaps, nodes, [*around, *range(count, len(nodes))]),
        )
        closed = [*places, *(loops[index] for index in solved.accepted)]
        return SolvedRun(
            T_map_node=solved.T_map_node[count:],
            loops=tuple(loop for loop in closed if fits(loop, solved.T_map_node)),
            own_loops=tuple(own_loops),
            T_map_loaded=solved.T_map_node[:count] if around else None,
        )

    def _believed(self, loops: Sequence[Edge]) -> list[Edge]:
        """Return the loops but those that are alone within a piece of the run, or between two.

        Nothing measured how pieces lie, so that loops of others neither contradict nor confirm one.
        """
        starts = sorted(self._starts)
        pieces = [
            tuple(bisect_right(starts, node) for node in (loop.first, loop.second))
            for loop in loops
        ]
        counts = Counter(pieces)
        kept = zip(loops, pieces, strict=True)
        return [loop for loop, ends in kept if counts[ends] > 1]

    def _is_used(self, loop: Edge) -> bool:
        return loop not in self._agreed or fits(loop, self._T_map_node)

    def _place(self, chain: Chain) -> None:
        """Place the new submaps by the motions to them."""
        nodes = list(self._T_map_node)
        for T_run_node in chain.T_run_node[len(nodes) :]:
            before = len(nodes) - 1
            if nodes:
                T_run_node = nodes[-1] @ se3.inverse(chain.T_run_node[before]) @ T_run_node
            nodes.append(T_run_node)
        self._T_map_node = np.array(nodes).reshape(-1, 4, 4)

    def _search(self, chain: Chain, *, is_level: bool) -> None:
        """Look for loops to the submaps that were not searched yet; plans show a level floor."""
        loops, query = list[Edge](), LoopQuery.of(chain, self._seen)
        self._starts = frozenset(query.starts)
        for second in range(self._seen, len(chain)):
            found, views = self._views.loops_to(query.to(second))
            loops += found
            chain.submaps[second] = replace(chain.submaps[second], views=views)
        for second in range(self._planned, len(chain) if is_level else 0):
            loops += self._plans.loops_to(query.to(second))
            loops += self._pieces.loops_to(query.to(second), self._T_map_node)
        if loops:
            self._found.add(loops, query.T_run_node, query.drift)
        self._seen, self._planned = len(chain), len(chain) if is_level else self._planned

    def _may_close(self, first: int, second: int, submaps: Sequence[Submap]) -> bool:
        """Tell whether a loop may lead from a submap to a later one: not within closed sessions."""
        a, b = submaps[first], submaps[second]
        if (a.run, a.session) != (b.run, b.session):
            return second - first > 1 or second in self._starts
        return second - first > 2 * NEIGHBOURS and not self._is_closed(a.session)


def places(loaded: SavedMap, chain: Chain, fixes: Sequence[Fix]) -> list[Edge]:
    """Return the loops to a loaded map by the fixes of a run that goes on."""
    known = {fix.stamp_ns: fix.T_run_base for fix in fixes}
    return _places(loaded, fixes, _Ends(chain, known.get))


def _places(loaded: SavedMap, fixes: Sequence[Fix], ends: _Ends) -> list[Edge]:
    """Return the loops from the loaded map's submaps to the run's, one per run submap.

    It is the mean of all its fixes, and as certain as one: they share their errors.
    """
    edges: dict[int, list[Edge]] = {}
    for fix in fixes:
        found = ends.of(fix.stamp_ns, fix.piece_ns)
        if found is not None:
            node, T_node_base = found
            T_base_node = se3.inverse(T_node_base)
            covariance = se3.carried(fix.covariance, T_node_base)
            place = loaded.loop_to(
                fix.T_map_base @ T_base_node, covariance, len(loaded.submaps) + node
            )
            edges.setdefault(node, []).append(place)
    return [_mean(loaded.T_map_node, same) for same in edges.values()]


def _mean(T_map_node: NDArray[np.float64], edges: Sequence[Edge]) -> Edge:
    """Return the mean of loops to one submap, weighted by their information."""
    start = edges[0]
    mean, covariance = se3.mean(
        [T_map_node[edge.first] @ edge.T_first_second for edge in edges],
        [edge.covariance for edge in edges],
    )
    T_first_second = se3.inverse(T_map_node[start.first]) @ mean
    return replace(start, T_first_second=T_first_second, covariance=covariance)


def _agreeing(
    places: Sequence[Edge], chain: Chain, T_map_node: NDArray[np.float64], drift: PathDrift
) -> list[Edge]:
    """Return the places that agree, in each piece of the run: nothing measured how those lie."""
    first = len(T_map_node) - len(chain)
    agreeing = list[Edge]()
    for start, end in pairwise([*chain.starts, len(chain)]):
        own = [place for place in places if start <= place.second - first < end]
        agreeing += [own[index] for index in consistent(own, T_map_node, drift)]
    return agreeing


class _Ends:
    """Finds the submap of a stamp and base in it, and where fixes put the submaps."""

    def __init__(self, chain: Chain, path: Path) -> None:
        self._chain, self._path = chain, path

    def of(self, stamp_ns: int, piece_ns: int = 0) -> tuple[int, Transform] | None:
        """Return the node and T_node_base (4, 4), None without a pose.

        Nor if the submap that lies in the same piece, which begins at `piece_ns`, still grows.
        """
        node, T_run_base = self._chain.node_at(stamp_ns), self._path(stamp_ns)
        if T_run_base is None or self._chain.submaps[node].stamps_ns[0] < piece_ns:
            return None
        return node, se3.inverse(self._chain.T_run_node[node]) @ T_run_base

    def placed(self, fixes: Sequence[Fix], T_map_node: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the nodes (N, 4, 4) where the last fix before each, or else the first, puts them.

        Nodes stay at `T_map_node` if no fix has a pose.
        """
        stamps_ns, T_map_run = [], []
        for fix in fixes:
            T_run_base = self._path(fix.stamp_ns)
            if T_run_base is not None:
                stamps_ns.append(fix.stamp_ns)
                T_map_run.append(fix.T_map_base @ se3.inverse(T_run_base))
        if not stamps_ns:
            return T_map_node
        starts_ns = [submap.stamps_ns[0] for submap in self._chain.submaps]
        last = np.searchsorted(stamps_ns, starts_ns, side="right") - 1
        T_run_node = np.array(self._chain.T_run_node)
        return np.asarray(np.array(T_map_run)[np.maximum(last, 0)] @ T_run_node)

    def edges_of(self, loops: Sequence[Edge]) -> list[Edge]:
        """Return a module's own loops, between submaps, without those within one."""
        found = []
        for loop in loops:
            start, end = self.of(loop.first), self.of(loop.second)
            if start is None or end is None or start[0] == end[0]:
                continue
            (first, T_first_from), (second, T_second_to) = start, end
            T = T_first_from @ loop.T_first_second @ se3.inverse(T_second_to)
            carried = se3.carried(loop.covariance, T_second_to)
            found.append(
                replace(loop, first=first, second=second, T_first_second=T, covariance=carried)
            )
        return found
