"""Close loops: some work per image; the pose graph in a worker, merged some images later."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future

from sceneslam.graphs.factors import fit
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from ..adjust.fusion import fuse_duplicates
from ..map.visual_map import VisualMap
from ..see.cores import thread_beside
from .loop_detection import LoopClosure, LoopDetector, Query
from .pose_graph import PoseGraph

_MERGE_IMAGES = 10  # after which a merge is due; a repeatable one waits for the worker
_HUBER_SIGMAS = 1.345  # 95 % efficiency relative to least squares, without outliers
_QUEUE = 3  # keyframes waiting for a query; older ones are dropped

Poses = Mapping[int, Transform]


class VisualLoopCloser:
    """Queries new keyframes, and corrects the map when two of them agree on a loop."""

    def __init__(
        self,
        visual_map: VisualMap,
        detector: LoopDetector,
        graph: PoseGraph,
        *,
        is_repeatable: bool,
    ) -> None:
        self._is_repeatable = is_repeatable
        self._map, self._detector, self._graph = visual_map, detector, graph
        self._worker = thread_beside("pose_graph")
        self._queries: deque[Query] = deque(maxlen=_QUEUE)
        self._candidate: int | None = None  # candidate of the first query, once it was found
        self._solution: Future[dict[int, Transform]] | None = None
        self._before: Poses = {}  # the poses that the worker began with
        self._loops: list[LoopClosure] = []
        self._images_left = 0

    @property
    def is_solving(self) -> bool:
        """Tell whether a pose graph is being solved, or its poses are not merged yet."""
        return self._solution is not None

    def insert(self, query: Query) -> None:
        """Add a new keyframe to the queue of queries."""
        if len(self._queries) == _QUEUE:
            self._candidate = None
        self._queries.append(query)

    def step(self) -> dict[int, Transform]:
        """Do one image's share of the work; return T_new_old per keyframe that was moved."""
        if self._solution is not None:
            self._images_left = max(self._images_left - 1, 0)
            is_late = not (self._is_repeatable or self._solution.done())
            return {} if self._images_left or is_late else self._merge(self._solution)
        if self._candidate is not None:
            self._check(self._queries.popleft(), self._candidate)
            self._candidate = None
        elif self._queries:
            self._look_up(self._queries[0])
        return {}

    def finish(self) -> dict[int, Transform]:
        """Merge the pending solution at once; return T_new_old per keyframe that was moved."""
        return {} if self._solution is None else self._merge(self._solution)

    def shutdown(self) -> None:
        """End the worker."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _look_up(self, query: Query) -> None:
        if query.keyframe_id in self._graph:
            self._candidate = self._detector.candidate(query)
        if self._candidate is None:
            self._queries.popleft()

    def _check(self, query: Query, candidate: int) -> None:
        if query.keyframe_id not in self._graph or candidate not in self._graph:
            return
        loops = self._detector.check(query, candidate)
        if not loops:
            return
        is_news = any(self._detector.is_news(loop) for loop in loops)
        if is_news:
            self._graph.remeasure(self._poses())
        met = self._met(loops[-1])
        for loop in loops:
            self._graph.connect(loop.edge)
        if is_news:
            self._begin(loops, met)
        else:
            self._fuse(loops)

    def _met(self, loop: LoopClosure) -> Poses:
        """Return the new poses of a whole segment that a loop connects for the first time."""
        segment = self._graph.connected(loop.keyframe_id)
        poses = self._poses()
        T_new_old = loop.T_local_base @ se3.inverse(poses[loop.keyframe_id])
        if loop.edge.first in segment:
            return {}
        other = self._graph.connected(loop.edge.first)
        if min(segment) < min(other):  # the older one stays
            segment, T_new_old = other, se3.inverse(T_new_old)
        return {k: T_new_old @ poses[k] for k in segment}

    def _begin(self, loops: list[LoopClosure], met: Poses) -> None:
        """Start solving the part of the graph with the loops; `met`: poses of a moved segment."""
        part = self._graph.connected(loops[0].keyframe_id)
        self._before = {k: T for k, T in self._poses().items() if k in part}
        edges = [edge for edge in self._graph.edges if edge.first in part]
        self._loops, self._images_left = loops, _MERGE_IMAGES
        first_guess = {**self._before, **met}
        self._solution = self._worker.submit(
            fit, first_guess, edges, held=min(part), huber_sigmas=_HUBER_SIGMAS
        )

    def _merge(self, solution: Future[dict[int, Transform]]) -> dict[int, Transform]:
        """Move the keyframes; newer ones move with the keyframe that they are connected to."""
        solved = solution.result()
        T_new_old = {k: T @ se3.inverse(self._before[k]) for k, T in solved.items()}
        for keyframe_id in self._graph.ids:
            if keyframe_id not in T_new_old:
                anchor = next(
                    (k for k in self._graph.neighbours(keyframe_id) if k in T_new_old), None
                )
                if anchor is not None:
                    T_new_old[keyframe_id] = T_new_old[anchor]
        T_new_old = {k: T for k, T in T_new_old.items() if k in self._graph}
        poses = self._poses()
        self._map.correct({k: T @ poses[k] for k, T in T_new_old.items()})
        self._fuse(self._loops)
        self._solution, self._loops = None, []
        return T_new_old

    def _fuse(self, loops: list[LoopClosure]) -> None:
        for loop in loops:
            if loop.edge.first in self._graph and loop.edge.second in self._graph:
                fuse_duplicates(self._map, old=loop.edge.first, new=loop.edge.second)

    def _poses(self) -> dict[int, Transform]:
        keyframes = self._map.keyframes
        return {keyframe_id: keyframes[keyframe_id].T_local_base for keyframe_id in keyframes.ids}
