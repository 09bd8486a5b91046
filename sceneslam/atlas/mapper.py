"""The back end of a run: submaps, localization in a loaded map, and the final pose graph.

Planar: for a robot whose base stays level. Scans that are not level are ignored, and a run without
level scans keeps the trajectory that its modules reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap, empty_map
from sceneslam.atlas.places.localizer import Fix, LocalizationEvent, MapLocalizer, PlacedScan
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.atlas.submaps.graph import Edge, EdgeKind, consistent, solve
from sceneslam.atlas.submaps.loop_closure import LoopFinder
from sceneslam.atlas.submaps.own_loops import OwnLoop, Path
from sceneslam.scans.key_scan import KeyScanner
from sceneslam.types import planar, se3
from sceneslam.types.observation import Observation
from sceneslam.types.planar import Planar
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform

_REST_NS = 1_000_000_000  # between two searches in the map while the robot stands
_UNFOUND_NS = 5_000_000_000  # after this time a run reports that it was not located
_RECENT = 80  # newest scans that the localizer gets

Note = Callable[..., None]  # event, stamp_ns, and its fields


class Mapper:
    """Takes observations after their poses; `finish` solves the graph."""

    def __init__(
        self,
        rig: Rig,
        *,
        known: Callable[[int], Known | None],
        note: Note,
        loaded: SavedMap | None = None,
        is_live: bool = False,
    ) -> None:
        """Begin. `is_live`: searches in the loaded map run in another thread."""
        self._loaded = loaded if loaded is not None else empty_map()
        self._scanner, self._known, self._note = KeyScanner(rig), known, note
        self._collector = Collector(rig, known, self._loaded.runs)
        plan = self._loaded.plan()
        self._localizer = MapLocalizer(plan) if len(plan) else None
        self._thread = ThreadPoolExecutor(1) if is_live else None
        self._search: Future[LocalizationEvent] | None = None
        self._recent: list[PlacedScan] = []
        self._T_map_run: Planar | None = None
        self._began_ns: int | None = None
        self._has_told = False
        self._loops: list[Edge] = []
        self._T_map_node: NDArray[np.float64] | None = None  # (N, 3) all nodes, once solved

    @property
    def is_placed(self) -> bool:
        """Tell whether the run was located in a loaded map."""
        return self._T_map_run is not None

    @property
    def is_found(self) -> bool:
        """Tell whether the run was located in the loaded map, or no map was loaded."""
        return self._localizer is None or self.is_placed

    @property
    def T_map_run(self) -> Transform:
        """Return T_map_run (4, 4) in the loaded map; the identity until the run was located."""
        found = self._T_map_run
        return se3.identity() if found is None else planar.to_transform(found)

    def observe(self, observation: Observation) -> None:
        """Take an observation whose pose is known."""
        known = self._known(observation.stamp_ns)
        if known is None:
            return
        is_step = self._collector.has_moved(known.T_map_base)
        if not is_step and not self._looks(observation.stamp_ns):
            return
        if is_step and not self._collector.step_to(known.T_map_base):
            return
        scan = self._scanner.make(observation)
        if scan is None:
            return
        if self._began_ns is None:
            self._began_ns = scan.stamp_ns
        if is_step:
            self._collector.add(scan)
        if self._localizer is not None:
            T_run_base = planar.from_transform(known.T_map_base)
            self._recent = [
                *self._recent[1 - _RECENT :],
                PlacedScan(scan=scan, T_run_base=T_run_base),
            ]
            self._localize(self._localizer, scan.stamp_ns)

    def finish(
        self, path: Path, own_loops: Sequence[OwnLoop], closed: frozenset[int]
    ) -> Correction:
        """Solve the graph; return the correction of the poses.

        `path` is revised by the modules, `own_loops` are the loops that they closed; `closed` are
        the sessions whose modules close loops themselves.
        """
        self._collector.finish()
        if self._thread is not None:
            self._thread.shutdown()
        submaps = self._collector.submaps
        if not submaps or not self._collector.is_level:
            return Correction.none()
        stamps_ns = np.array([submap.stamps_ns[0] for submap in submaps], np.int64)
        old = np.array([_planar_at(path, int(stamp_ns)) for stamp_ns in stamps_ns])
        self._collector.remeasure(old)
        self._collector.motions += [
            edge for loop in own_loops if (edge := self._edge_of(loop, path)) is not None
        ]
        T_map_run = planar.from_transform(self.T_map_run)
        new = self._solve(np.array([planar.compose(T_map_run, T) for T in old]), path, closed)
        if not self._loops and not self.is_placed:
            return Correction.none()
        T_new_old = [
            planar.compose(T, planar.between(before, np.zeros(3)))
            for T, before in zip(new, old, strict=True)
        ]
        return Correction(stamps_ns=stamps_ns, T_new_old=np.array(T_new_old))

    def saved(self) -> SavedMap:
        """Return the loaded map with this run in it: a separate piece if it was not located."""
        count, pieces = len(self._loaded.submaps), self._loaded.pieces
        T_map_run, own = planar.from_transform(self.T_map_run), self._collector
        nodes = self._T_map_node
        if nodes is None:
            placed = [planar.compose(T_map_run, T) for T in own.T_run_node]
            nodes = np.concatenate([self._loaded.T_map_node, np.reshape(placed, (-1, 3))])
        piece = 0 if self.is_found else int(pieces.max(initial=-1)) + 1
        return SavedMap(
            submaps=(*self._loaded.submaps, *own.submaps),
            T_map_node=nodes,
            pieces=np.concatenate([pieces, np.full(len(own.submaps), piece, np.int64)]),
            edges=(
                *self._loaded.edges,
                *(edge.shifted(count) for edge in own.motions),
                *self._loops,
            ),
        )

    # During the run.

    def _looks(self, stamp_ns: int) -> bool:
        """Tell whether a robot at rest should search the map."""
        if self.is_found or not self._recent:
            return False
        return stamp_ns - self._recent[-1].scan.stamp_ns >= _REST_NS

    def _localize(self, localizer: MapLocalizer, stamp_ns: int) -> None:
        if self._search is not None:
            if not self._search.done():
                return
            self._take(self._search.result(), localizer, stamp_ns)
            self._search = None
        if not localizer.is_due(self._recent[-1]):
            outcome = LocalizationEvent.NOTHING
        elif self._thread is not None:
            self._search = self._thread.submit(localizer.compare, tuple(self._recent))
            return
        else:
            outcome = localizer.compare(self._recent)
        self._take(outcome, localizer, stamp_ns)

    def _take(self, outcome: LocalizationEvent, localizer: MapLocalizer, stamp_ns: int) -> None:
        """Process the result of a comparison with the map."""
        assert self._began_ns is not None
        after_s = (stamp_ns - self._began_ns) / 1e9
        self._T_map_run = localizer.T_map_run
        if outcome is LocalizationEvent.FOUND:
            self._note(outcome.value, stamp_ns, after_s=after_s, T_map_run=self.T_map_run.tolist())
        elif outcome is LocalizationEvent.WITHDRAWN:
            self._note(outcome.value, stamp_ns, after_s=after_s)
        elif not self.is_found and not self._has_told and after_s * 1e9 >= _UNFOUND_NS:
            self._note("not_relocalized", stamp_ns, after_s=after_s)
            self._has_told = True

    # At the end.

    def _solve(
        self, new: NDArray[np.float64], path: Path, closed: frozenset[int]
    ) -> NDArray[np.float64]:
        """Find the loops and solve; return the run's nodes (N, 3), from the initial `new`."""
        own, count = self._collector, len(self._loaded.submaps)
        nodes = np.concatenate([self._loaded.T_map_node, new])
        drift = np.concatenate([np.zeros((count, 3)), np.array(own.drift)])
        finder = LoopFinder(own.submaps, closed)
        candidates = fixes = self._fix_edges(path)
        for second in range(len(own.submaps)):
            found = finder.loops_to(second, new, np.array(own.drift))
            candidates = [*candidates, *(edge.shifted(count) for edge in found)]
        loops = consistent(candidates, nodes, drift)
        if len(loops) < 2 and not fixes:
            loops = []  # no other loop agrees with it
        motions = [*self._loaded.edges, *(edge.shifted(count) for edge in own.motions)]
        solved = solve(nodes, motions, loops, fixed=range(count), loose=count)
        self._loops, self._T_map_node = list(solved.loops), solved.T_map_node
        for loop in self._loops:
            self._tell(loop, count)
        return solved.T_map_node[count:]

    def _tell(self, loop: Edge, count: int) -> None:
        submaps = [*self._loaded.submaps, *self._collector.submaps]
        first, second = submaps[loop.first], submaps[loop.second]
        fields: dict[str, Any] = {"module": second.module, "to_module": first.module}
        fields |= {"to_ns": int(first.stamps_ns[0]), "in_loaded_map": loop.first < count}
        self._note("loop", int(second.stamps_ns[0]), **fields)

    def _edge_of(self, loop: OwnLoop, path: Path) -> Edge | None:
        """Return a module's own loop as an edge between submaps, None where they are the same."""
        first, second = (self._collector.node_at(stamp) for stamp in (loop.from_ns, loop.to_ns))
        start, end = path(loop.from_ns), path(loop.to_ns)
        if start is None or end is None or first == second:
            return None
        T_from_second = planar.compose(loop.T_from_to, self._back(end, second))
        return Edge(
            first=first,
            second=second,
            T_first_second=planar.compose(self._away(start, first), T_from_second),
            covariance=loop.covariance,
            kind=EdgeKind.LOOP,
        )

    def _fix_edges(self, path: Path) -> list[Edge]:
        """Return the loops from the loaded map's submaps to the run's, at most one per run submap.

        More would not be independent: fixes in one place share their errors.
        """
        if self._localizer is None or not self.is_placed:
            return []
        edges: dict[int, Edge] = {}
        for fix in self._localizer.fixes:
            node, pose = self._collector.node_at(fix.stamp_ns), path(fix.stamp_ns)
            if pose is not None and node not in edges:
                edges[node] = self._fix_edge(fix, node, self._back(pose, node))
        return list(edges.values())

    def _fix_edge(self, fix: Fix, node: int, T_base_node: Planar) -> Edge:
        """Return the loop to a node from the nearest submap of the loaded map."""
        count, nodes = len(self._loaded.submaps), self._loaded.T_map_node
        away_m = np.hypot(*(nodes[:, :2] - fix.T_map_base[:2]).T)
        first = int(np.argmin(np.where(self._loaded.pieces == 0, away_m, np.inf)))
        T_map_node = planar.compose(fix.T_map_base, T_base_node)
        # In base's axes at the fix, then carried to the node.
        carried = planar.propagate(fix.match.covariance, np.zeros(3), T_base_node, np.zeros((3, 3)))
        turn = planar.turn(-float(T_base_node[2]))
        return Edge(
            first=first,
            second=count + node,
            T_first_second=planar.between(nodes[first], T_map_node),
            covariance=turn @ carried @ turn.T,
            kind=EdgeKind.LOOP,
        )

    def _away(self, T_run_base: Transform, node: int) -> Planar:
        """Return T_node_base."""
        return planar.between(self._collector.T_run_node[node], planar.from_transform(T_run_base))

    def _back(self, T_run_base: Transform, node: int) -> Planar:
        """Return T_base_node."""
        return planar.between(self._away(T_run_base, node), np.zeros(3))


def _planar_at(path: Path, stamp_ns: int) -> Planar:
    found = path(stamp_ns)
    assert found is not None  # its scan had a pose
    return planar.from_transform(found)
