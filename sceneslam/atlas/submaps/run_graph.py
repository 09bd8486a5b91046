"""The graph of a run and of the map that it was located in: its loops, and its solution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.localizer import Fix
from sceneslam.atlas.submaps.collector import Collector
from sceneslam.atlas.submaps.graph import Upright, consistent, solve
from sceneslam.atlas.submaps.loop_closure import LoopFinder
from sceneslam.atlas.submaps.own_loops import OwnLoop, Path, closed_loops, recognized_loops
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.motion.tilt import upright
from sceneslam.types import planar, se3
from sceneslam.types.maps import MapLayers
from sceneslam.types.se3 import Transform


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SolvedRun:
    """The run's nodes after optimisation, and the accepted loops."""

    T_map_node: NDArray[np.float64]  # (N, 4, 4), as many as the run has submaps
    loops: tuple[Edge, ...]  # nodes of the loaded map are counted first


class RunGraph:
    """Joins the submaps of a run, at their revised poses, with a loaded map."""

    def __init__(self, own: Collector, loaded: SavedMap, path: Path) -> None:
        """Take the finished submaps of a run; `path` are its poses as revised by the modules."""
        self._own, self._loaded, self._path = own, loaded, path
        self._count = len(loaded.submaps)

    def solve(
        self,
        T_map_node: NDArray[np.float64],
        maps: Sequence[MapLayers],
        fixes: Sequence[Fix],
        closed: frozenset[int],
    ) -> SolvedRun:
        """Find the loops and solve, from the initial nodes (N, 4, 4) of the run.

        `maps` are those of the modules, with their own loops, `fixes` the places where the run was
        located in the loaded map, `closed` the sessions whose modules close loops themselves.
        """
        own, count = self._own, self._count
        motions = [*own.motions, *self._edges_of(closed_loops(maps))]
        plane, drift = planar.from_transforms(T_map_node), np.array(own.drift)
        fixed = self._fix_edges(fixes)
        recognized = [edge.shifted(count) for edge in self._edges_of(recognized_loops(maps))]
        finder = LoopFinder(own.submaps, closed)
        found = [
            edge.shifted(count)
            for second in range(len(own.submaps) if own.is_level else 0)
            for edge in finder.loops_to(second, plane, drift)
        ]
        loops = [*fixed, *recognized, *found]
        nodes = np.concatenate([self._loaded.T_map_node, T_map_node])
        agreeing = consistent(loops, nodes, np.concatenate([np.zeros((count, 3)), drift]))
        if len(agreeing) < 2 and not fixed:
            agreeing = []  # no other loop agrees with it
        solved = solve(
            nodes,
            [edge.shifted(count) for edge in motions],
            [loops[index] for index in agreeing],
            fixed=range(count),
            loose=count,
            uprights=self._uprights(T_map_node),
        )
        return SolvedRun(
            T_map_node=solved.T_map_node[count:],
            loops=tuple(loops[agreeing[index]] for index in solved.accepted),
        )

    def _uprights(self, T_map_node: NDArray[np.float64]) -> list[Upright]:
        """Return the vertical directions; the first one gives that of the map.

        Base is level most of the time: a sensor that is mounted askew has the same tilt everywhere.
        """
        nodes, measured = list(self._own.up_node), list(self._own.up_node.values())
        if not measured:
            return []
        askew = upright(se3.identity(), np.median(measured, axis=0))[:3, :3]
        ups = [askew @ up_base for up_base in measured]
        up_map = T_map_node[nodes[0], :3, :3] @ ups[0]
        return [
            Upright(node=self._count + node, up_node=up, up_map=up_map)
            for node, up in zip(nodes, ups, strict=True)
        ]

    def _edges_of(self, loops: Sequence[OwnLoop]) -> list[Edge]:
        """Return a module's own loops as edges between submaps, without those within one."""
        found = []
        for loop in loops:
            first, second = (self._own.node_at(ns) for ns in (loop.from_ns, loop.to_ns))
            start, end = self._path(loop.from_ns), self._path(loop.to_ns)
            if start is None or end is None or first == second:
                continue
            T_first_from = se3.inverse(self._own.T_run_node[first]) @ start
            T_to_second = se3.inverse(end) @ self._own.T_run_node[second]
            found.append(
                Edge(
                    first=first,
                    second=second,
                    T_first_second=T_first_from @ loop.T_from_to @ T_to_second,
                    covariance=se3.carried(loop.covariance, se3.inverse(T_to_second)),
                    kind=EdgeKind.LOOP,
                )
            )
        return found

    def _fix_edges(self, fixes: Sequence[Fix]) -> list[Edge]:
        """Return the loops from the loaded map's submaps to the run's, one per run submap.

        It is the mean of all its fixes, and as certain as one: they share their errors.
        """
        edges: dict[int, list[Edge]] = {}
        for fix in fixes:
            node, pose = self._own.node_at(fix.stamp_ns), self._path(fix.stamp_ns)
            if pose is not None:
                T_base_node = se3.inverse(pose) @ self._own.T_run_node[node]
                edges.setdefault(node, []).append(self._fix_edge(fix, node, T_base_node))
        return [self._mean(same) for same in edges.values()]

    def _mean(self, edges: Sequence[Edge]) -> Edge:
        """Return the mean of loops to one submap, weighted by their information."""
        nodes, start = self._loaded.T_map_node, edges[0]
        mean, covariance = se3.mean(
            [nodes[edge.first] @ edge.T_first_second for edge in edges],
            [edge.covariance for edge in edges],
        )
        return replace(
            start,
            T_first_second=se3.inverse(nodes[start.first]) @ mean,
            covariance=covariance,
        )

    def _fix_edge(self, fix: Fix, node: int, T_base_node: Transform) -> Edge:
        """Return the loop to a node from the nearest submap of the loaded map."""
        nodes, first = self._loaded.T_map_node, self._loaded.nearest(fix.T_map_base)
        return Edge(
            first=first,
            second=self._count + node,
            T_first_second=se3.inverse(nodes[first]) @ fix.T_map_base @ T_base_node,
            covariance=se3.carried(fix.covariance, se3.inverse(T_base_node)),
            kind=EdgeKind.LOOP,
        )
