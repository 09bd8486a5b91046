"""The pose graph: keyframes, measured motions between them, and the optimised poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from heapq import heappop, heappush

import numpy as np

from sceneslam.graphs.edge import Edge
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

_RADIAN_M = 1.0  # metres that a radian counts in the length of a path


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A path through the graph: its motion and the uncertainty of that."""

    length_m: float
    turned_rad: float
    reach_m: float  # from its end to the farthest keyframe on it
    sigma_m: float  # of all steps' translations, without the effect of rotation errors
    sigma_rad: float


class PoseGraph:
    """Keyframes by id, and the edges between them."""

    def __init__(self) -> None:
        self._edges: dict[int, dict[int, Edge]] = {}  # stored at both ends, beginning there

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._edges

    @property
    def ids(self) -> list[int]:
        """Return the keyframes' ids, in the order of their insertion."""
        return list(self._edges)

    @property
    def edges(self) -> list[Edge]:
        """Return every edge once, from the lower to the higher id."""
        return [e for near in self._edges.values() for e in near.values() if e.first < e.second]

    def insert(self, keyframe_id: int) -> None:
        """Add a keyframe without edges."""
        self._edges[keyframe_id] = {}

    def connect(self, edge: Edge) -> None:
        """Add an edge between two keyframes; it replaces an existing one."""
        self._edges[edge.first][edge.second] = edge
        self._edges[edge.second][edge.first] = edge.turned()

    def neighbours(self, keyframe_id: int) -> list[int]:
        """Return the ids of the keyframes connected by an edge."""
        return list(self._edges[keyframe_id])

    def remove(self, keyframe_id: int) -> Edge | None:
        """Remove a keyframe; its most certain neighbour takes over the other edges.

        A neighbour by a loop does so only without others, as all these edges would become loops.
        Returns the edge from that neighbour to the keyframe, None without neighbours.
        """
        near = self._edges.pop(keyframe_id)
        for other in near:
            del self._edges[other][keyframe_id]
        if not near:
            return None
        heir = min(near.values(), key=lambda e: (e.is_loop, float(np.trace(e.covariance))))
        to_gone = heir.turned()
        for other, edge in near.items():
            if other != heir.second and other not in self._edges[heir.second]:
                self.connect(to_gone.then(edge))
        return to_gone

    def remeasure(self, T_local_base: Mapping[int, Transform]) -> None:
        """Set all edges but loops from the keyframes' adjusted poses."""
        for edge in self.edges:
            if not edge.is_loop:
                T_first_second = se3.inverse(T_local_base[edge.first]) @ T_local_base[edge.second]
                self.connect(replace(edge, T_first_second=T_first_second))

    def connected(self, keyframe_id: int) -> set[int]:
        """Return the keyframes that are connected to this one, including itself."""
        found, queue = {keyframe_id}, [keyframe_id]
        while queue:
            for other in self._edges[queue.pop()]:
                if other not in found:
                    found.add(other)
                    queue.append(other)
        return found

    def way(self, start: int, end: int) -> Way | None:
        """Return the shortest path (Dijkstra), None if the two are not connected."""
        heap: list[tuple[float, int, int]] = [(0.0, start, start)]
        before: dict[int, int] = {}
        while heap:
            length, keyframe_id, previous = heappop(heap)
            if keyframe_id in before:
                continue
            before[keyframe_id] = previous
            if keyframe_id == end:
                return self._measure(before, end)
            for other, edge in self._edges[keyframe_id].items():
                if other not in before:
                    heappush(heap, (length + _length(edge), other, keyframe_id))
        return None

    def _measure(self, before: Mapping[int, int], end: int) -> Way:
        length_m = turned_rad = reach_m = 0.0
        variances = np.zeros(6)
        T_end_here, here = se3.identity(), end
        while before[here] != here:
            edge = self._edges[here][before[here]]
            step = edge.T_first_second
            variances += np.diag(edge.covariance)
            length_m += float(np.linalg.norm(step[:3, 3]))
            turned_rad += float(se3.rotation_angle_rad(step))
            T_end_here, here = T_end_here @ step, before[here]
            reach_m = max(reach_m, float(np.linalg.norm(T_end_here[:3, 3])))
        return Way(
            length_m=length_m,
            turned_rad=turned_rad,
            reach_m=reach_m,
            sigma_m=float(np.sqrt(variances[:3].sum())),
            sigma_rad=float(np.sqrt(variances[3:].sum())),
        )


def _length(edge: Edge) -> float:
    T = edge.T_first_second
    return float(np.linalg.norm(T[:3, 3]) + _RADIAN_M * se3.rotation_angle_rad(T))
