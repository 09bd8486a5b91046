"""The back end of a run: its submaps, their pose graph, and the loaded map that they continue.

The graph is spatial. Places are recognized by floor plans of level scans and by what a camera sees,
whatever module was active; only within the sessions of a module that closes loops itself are none
looked for.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap, empty_map
from sceneslam.atlas.places.floor_plan import grid_of
from sceneslam.atlas.places.localizer import Look, MapLocalizer
from sceneslam.atlas.places.map_search import MapSearch
from sceneslam.atlas.places.view_taker import ViewTaker
from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.atlas.submaps.graph import LOADED, fits
from sceneslam.atlas.submaps.own_loops import Path
from sceneslam.atlas.submaps.run_graph import RunGraph, SolvedRun, places
from sceneslam.atlas.submaps.uprights import straightened
from sceneslam.executors import executor
from sceneslam.graphs.edge import Edge
from sceneslam.scans.key_scan import KeyScan, KeyScanner
from sceneslam.types import planar, se3
from sceneslam.types.errors import InputError, text_of
from sceneslam.types.maps import GridLayer, MapLayers
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import Note
from sceneslam.types.se3 import Transform, Vector
from sceneslam.types.trail import Trail
from sceneslam.views.view import Landmarks
from sceneslam.views.view_finder import ViewFinder

_log = logging.getLogger(__name__)


class Mapper:
    """Takes observations after their poses; closes loops while the run goes on, and at its end."""

    def __init__(
        self,
        rig: Rig,
        *,
        known: Callable[[int], Known | None],
        note: Note,
        loaded: SavedMap | None = None,
        is_closed: Callable[[int], bool] = lambda session: False,
        keeps_views: bool = False,
        moves_loaded: bool = False,
        is_live: bool = False,
    ) -> None:
        """Begin. `keeps_views`: submaps hold what the camera sees, by which places are recognized.

        `is_closed` tells in which sessions modules close loops themselves. `moves_loaded`: at the
        end the loaded map is optimised, too. `is_live`: searches run in another thread.
        """
        self._loaded = loaded if loaded is not None else empty_map()
        self._scanner, self._known, self._note = KeyScanner(rig), known, note
        self._trail = Trail()
        self._is_rewound = False  # so that the trail is of poses that were replaced
        self._plan, views = self._loaded.plan(), self._loaded.views()
        self._views = ViewTaker(rig, is_keeping=keeps_views, is_comparing=bool(views))
        self._collector = Collector(rig, known, self._loaded.runs, self._views.locate)
        self._executor = executor("search", is_live=is_live)
        localizer = self._made_localizer(rig, views)
        self._search = MapSearch(localizer, executor=self._executor, path=self._pose_at, note=note)
        self._is_level = True  # at the last step
        self._has_refused = False  # a measurement
        self.faults: list[str] = []
        self._graph: RunGraph | None = RunGraph(
            self._loaded, is_closed, moves_loaded=moves_loaded
        )  # None once it failed
        self._solving: tuple[Chain, Future[SolvedRun]] | None = None
        self._kept = 0  # submaps that are as they were given to the graph
        self._solved = SolvedRun(T_map_node=np.zeros((0, 4, 4)), loops=())
        self._is_news = False  # nodes were moved since the correction was taken
        self._is_over = False
        self._told: dict[tuple[int, int, int], dict[str, Any]] = {}  # loops, by run and stamps

    @property
    def is_placed(self) -> bool:
        """Tell whether the run was located in a loaded map."""
        return self._search.is_placed

    @property
    def was_found(self) -> bool:
        """Tell whether the run was located in the loaded map at any time."""
        return self._search.was_found

    @property
    def has_submaps(self) -> bool:
        """Tell whether the run has submaps, so that there is something to save."""
        return bool(len(self._collector.chain))

    @property
    def is_found(self) -> bool:
        """Tell whether the run was located in the loaded map, or no map was loaded."""
        return self.is_placed or not self._loaded.submaps

    def loaded_grid(self) -> GridLayer | None:
        """Return the grid of the loaded map, None without walls; may be called in any thread."""
        plan = self._plan
        return grid_of(plan) if len(plan) or plan.free.any() else None

    @property
    def T_map_run(self) -> Transform:
        """Return T_map_run (4, 4) in the loaded map; the identity until the run was located."""
        return self._search.T_map_run

    def take_correction(self) -> Correction | None:
        """Return the correction of the poses by loops or the loaded map, None if it is as before.

        That of the newest submap holds for the newest pose, too.
        """
        is_located_anew = self._search.take_news()
        if not (self._is_news or is_located_anew):
            return None
        self._is_news = False
        chain = self._collector.chain
        if self.is_placed or not self._solved.loops:
            T_new_old = np.array(self._T_map_runs() or [self.T_map_run])
        else:
            nodes = self._solved.T_map_node
            T_new_old = nodes @ se3.inverse(np.array(chain.T_run_node[: len(nodes)]))
        return self._correction(T_new_old)

    def rewind(self, stamp_ns: int) -> None:
        """Remove what was made of poses from a stamp on: they are replaced."""
        self._search.rewind(stamp_ns)
        self._collector.rewind(stamp_ns)
        self._views.rewind(stamp_ns)
        self._is_rewound = True
        kept = len(self._collector.chain)
        if kept < self._kept:
            self._is_news |= bool(self._solved.loops)
            self._kept, self._solved = kept, self._solved.cut(kept, len(self._loaded.submaps))

    def observe(self, observation: Observation, up_base: Vector | None) -> None:
        """Add an observation with a known pose, and the upward direction (3,) in base."""
        known = self._known(observation.stamp_ns)
        if known is None:
            return
        stamp_ns, search = observation.stamp_ns, self._search
        self._views.move(stamp_ns, known.T_map_base)
        self._collect_loops()
        if self._is_rewound:
            self._trail, self._is_rewound = self._trail.retraced(self._pose_at), False
        is_begun = self._collector.has_begun(known)
        if is_begun:
            search.restart(known.begun_ns)
            self._trail = Trail()
        self._trail.add(stamp_ns, known.T_map_base)
        search.collect(stamp_ns)
        look = Look(stamp_ns=stamp_ns, T_run_base=known.T_map_base)
        is_step = is_begun or self._collector.has_moved(known)
        is_scanned = is_step or search.rests(stamp_ns)
        is_viewed = search.wants_view(look)
        is_viewed &= is_step or not search.is_located  # fixes are by walls first, in steps
        if not (is_scanned or is_viewed):
            return
        if is_step:
            self._is_level = self._collector.step_to(known.T_map_base)
        scan = self._scan(observation) if is_scanned and self._is_level else None
        view, is_kept = None, is_step and self._views.is_kept(observation, known.T_map_base)
        if is_kept or is_viewed:
            view = self._views.take(observation)
        if is_step:
            if view is not None and is_kept:
                self._views.keep(known.T_map_base)
            self._collector.add(stamp_ns, scan, up_base, view if is_kept else None)
            self._close_loops()
        if scan is not None or view is not None:
            is_level = self._is_level and self._collector.is_level
            view = view if is_viewed else None
            search.look(replace(look, scan=scan, view=view, is_level=is_level))

    def close(self) -> None:
        """Begin no other search; one that is running goes on, and nothing takes its result."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def finish(self, path: Path, maps: Sequence[MapLayers]) -> Correction:
        """Solve the graph; return the correction of the poses. `faults` says if it failed.

        `path` is revised by the modules, `maps` are theirs, with their own loops.
        """
        self._collector.finish()
        self._executor.shutdown()
        self._collect_loops()
        chain = self._collector.chain
        if not len(chain):
            return Correction.none()
        self._search.collect(int(chain.submaps[-1].stamps_ns[-1]))
        chain.remeasure(path)
        old = np.array(chain.T_run_node)
        start, is_level = self.T_map_run @ old, self._collector.is_level
        if self._graph is not None:
            self._graph.forget(self._kept)
            try:
                self._solved = self._graph.finish(
                    chain, start, path, maps, self._search.fixes, is_level=is_level
                )
            except Exception as error:
                self._give_up_graph("the graph was not solved at the end", error)
        if self._graph is None:  # what was solved during the run is kept
            self._solved = self._last_solved(np.array(self._T_map_runs()) @ old)
        self._is_over = True
        self._tell_loops()
        if not (self._solved.loops or chain.is_upright or self.is_placed):
            return Correction.none()
        return self._correction(self._solved.T_map_node @ se3.inverse(old))

    def loops(self, stamps_ns: NDArray[np.int64]) -> list[Edge]:
        """Return the accepted loops between rows of the path with these stamps (N,).

        They lead from and to the middles of submaps: what is seen along all of one places that.
        """
        submaps, count = self._collector.chain.submaps, len(self._loaded.submaps)
        middles = [len(submap.stamps_ns) // 2 for submap in submaps]
        owned = list(zip(submaps, middles, strict=True))
        middles_ns = [submap.stamps_ns[row] for submap, row in owned]
        rows = [LOADED] * count + np.searchsorted(stamps_ns[:-1], middles_ns).tolist()
        T_node_middle = [se3.identity()] * count
        T_node_middle += [planar.to_transform(submap.T_submap_base[row]) for submap, row in owned]
        return [
            replace(
                loop,
                first=rows[loop.first],
                second=rows[loop.second],
                T_first_second=se3.inverse(T_node_middle[loop.first])
                @ loop.T_first_second
                @ T_node_middle[loop.second],
                covariance=se3.carried(loop.covariance, se3.inverse(T_node_middle[loop.second])),
            )
            for loop in self._solved.loops
        ]

    def saved(self) -> SavedMap:
        """Return the loaded map with this run in it.

        What nothing joins is a separate piece: of the run, or all of a run that was not located.
        """
        count, own = len(self._loaded.submaps), self._collector.chain
        moved = self._solved.T_map_loaded
        loaded = self._loaded.T_map_node if moved is None else moved
        # While a run goes on that was located, nodes are solved in its own frame.
        is_in_map = self._is_over or not self.is_placed
        nodes = [*self._solved.T_map_node] if is_in_map else []
        if nodes:
            T_map_run = nodes[-1] @ se3.inverse(own.T_run_node[len(nodes) - 1])
            nodes += [T_map_run @ T_run_node for T_run_node in own.T_run_node[len(nodes) :]]
        else:
            located = zip(self._T_map_runs(), own.T_run_node, strict=True)
            nodes = [T_map_run @ T_run_node for T_map_run, T_run_node in located]
        T_map_node = np.concatenate([loaded, np.reshape(nodes, (-1, 4, 4))])
        loops = [
            *self._solved.own_loops,
            *self._solved.loops,
            *(place for place in self._places() if fits(place, T_map_node)),
        ]
        saved = SavedMap(
            submaps=(*self._loaded.submaps, *straightened(own)),
            T_map_node=T_map_node,
            pieces=np.concatenate([self._loaded.pieces, self._own_pieces(loops)]),
            edges=(
                *self._loaded.edges,
                *(edge.shifted(count) for edge in own.ties),
                *loops,
            ),
        )
        saved = saved.without_guesses()
        return saved.without_misfits() if self._is_over else saved

    def _own_pieces(self, loops: Sequence[Edge]) -> NDArray[np.int64]:
        """Return the piece of each submap of the run, by the parts that loops join.

        The first is what loops lead to from the loaded map; without one, the part with most
        submaps.
        """
        chain, count = self._collector.chain, len(self._loaded.submaps)
        own = [loop.shifted(-count) for loop in loops]
        located = {loop.second for loop in own if loop.first < 0}
        pieces, piece = np.zeros(len(chain), np.int64), int(self._loaded.pieces.max(initial=-1)) + 1
        for part in chain.parts(own):
            if located.isdisjoint(part):
                pieces[part], piece = piece, piece + 1
        return pieces

    def _places(self) -> list[Edge]:
        """Return the loops to the loaded map that are not solved: the run goes on, or it failed."""
        is_solved = self._is_over and self._graph is not None
        chain = self._collector.chain
        if is_solved or not len(chain):
            return []
        return places(self._loaded, chain, self._search.fixes)

    def _T_map_runs(self) -> list[Transform]:
        """Return T_map_run (4, 4) of each submap."""
        submaps = self._collector.chain.submaps
        return self._search.T_map_runs([int(submap.stamps_ns[0]) for submap in submaps])

    # During the run.

    def _close_loops(self) -> None:
        """Give the submaps that are complete to the graph, if it is not busy."""
        chain = self._collector.chain
        if self._graph is None or self._solving is not None or len(chain) == self._kept:
            return
        self._graph.forget(self._kept)
        self._kept, chain = len(chain), chain.copy()
        extend = partial(self._graph.extend, chain, is_level=self._collector.is_level)
        self._solving = chain, self._executor.submit(extend)
        self._collect_loops()

    def _collect_loops(self) -> None:
        """Take the solution of the graph, if there is a new one."""
        if self._solving is None or not self._solving[1].done():
            return
        (chain, solving), self._solving = self._solving, None
        try:
            solved = solving.result()
        except Exception as error:
            self._give_up_graph("the graph of the run gets no further loops", error)
            return
        kept = min(len(chain), self._kept)  # less, if poses were replaced meanwhile
        self._collector.chain.submaps[:kept] = chain.submaps[:kept]  # views were left out
        if kept < len(chain):
            return
        self._is_news |= bool(solved.loops or self._solved.loops)
        self._solved = solved
        self._tell_loops()

    def _give_up_graph(self, what: str, error: Exception) -> None:
        """Keep the graph's last solution, to which no loops are added any more."""
        _log.info("graph", exc_info=error)
        self.faults.append(f"{what}, its last solution stays: {text_of(error)}")
        self._graph = None

    def _correction(self, T_new_old: NDArray[np.float64]) -> Correction:
        """Return the correction by those of the first submaps (N, 4, 4).

        A piece of the run moves alone: from the end of the one before to its beginning they jump.
        """
        chain = self._collector.chain
        stamps_ns = [int(submap.stamps_ns[0]) for submap in chain.submaps[: len(T_new_old)]] or [0]
        knots = dict(zip(stamps_ns, T_new_old, strict=True))
        for start in chain.starts[1:]:
            if start < len(stamps_ns) and (known := self._known(stamps_ns[start])) is not None:
                knots.setdefault(known.begun_ns - 1, T_new_old[start - 1])
                knots.setdefault(known.begun_ns, T_new_old[start])
        piece_ns = self._search.piece_ns
        if self.is_placed and stamps_ns[-1] < piece_ns:  # its first submap grows
            knots |= {piece_ns - 1: T_new_old[-1], piece_ns: self.T_map_run}
        return Correction(
            stamps_ns=np.array(sorted(knots), np.int64),
            T_new_old=np.array([knots[stamp_ns] for stamp_ns in sorted(knots)]),
        )

    def _last_solved(self, T_map_node: NDArray[np.float64]) -> SolvedRun:
        """Return the last solution during the run, for all of its nodes (N, 4, 4).

        Later nodes follow it by the motions. It was without the loaded map: a run that was located
        in that stays where it was located.
        """
        solved, loops = self._solved.T_map_node, self._solved.loops
        if not loops or self.is_placed:
            return SolvedRun(T_map_node=T_map_node, loops=loops)
        last = len(solved) - 1
        later = solved[last] @ se3.inverse(T_map_node[last]) @ T_map_node[last + 1 :]
        return SolvedRun(T_map_node=np.concatenate([solved, later]), loops=loops)

    def _made_localizer(
        self, rig: Rig, views: Sequence[tuple[Transform, Landmarks]]
    ) -> MapLocalizer | None:
        """Return the localizer in the loaded map, None if no sensor sees what it shows."""
        plan, finder = self._plan, None
        if views and rig.camera is not None and Sensor.IMAGE in rig.sensors:
            finder = ViewFinder(rig.camera, views)
        if finder is None and not (len(plan) and self._scanner.can_scan):
            if self._loaded.submaps:
                shown = " and ".join(["walls"] * bool(len(plan)) + ["views"] * bool(views))
                why = f"the robot has no sensor for the {shown} in it"
                why = why if shown else "it shows neither walls nor views"
                self._warn(0, f"the run will not be found in the loaded map: {why}")
            return None
        return MapLocalizer(plan, finder, standing=self._loaded.standing, wheels=rig.wheels)

    def _scan(self, observation: Observation) -> KeyScan | None:
        """Return the scan of an observation; None without one, or with an invalid measurement."""
        try:
            return self._scanner.make(observation, self._trail)
        except InputError as error:  # as of a depth image that has another size than before
            if not self._has_refused:
                self._warn(
                    observation.stamp_ns, f"the submaps are without such a measurement: {error}"
                )
            self._has_refused = True
            return None

    def _warn(self, stamp_ns: int, what: str) -> None:
        _log.warning("%s", what)
        self._note("warning", stamp_ns, what=what)

    def _pose_at(self, stamp_ns: int) -> Transform | None:
        known = self._known(stamp_ns)
        return None if known is None else known.T_map_base

    def _tell_loops(self) -> None:
        """Report the loops that are new, and those that the last solution has withdrawn."""
        submaps = [*self._loaded.submaps, *self._collector.chain.submaps]
        before, self._told = self._told, {}
        for loop in self._solved.loops:
            first, second = submaps[loop.first], submaps[loop.second]
            ends = first.run, int(first.stamps_ns[0]), int(second.stamps_ns[0])
            self._told[ends] = {
                "module": second.module,
                "to_module": first.module,
                "to_ns": ends[1],
                "in_loaded_map": loop.first < len(self._loaded.submaps),
            }
        for ends, fields in before.items():
            if ends not in self._told:
                self._note("loop_withdrawn", ends[2], **fields)
        for ends, fields in self._told.items():
            if ends not in before:
                self._note("loop", ends[2], **fields)
