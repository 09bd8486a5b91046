"""Detect loops: two new keyframes that agree on showing a place seen before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.spread import spread

from ...model_error import motion_covariance
from ..locate.localizer import VisualFix
from ..locate.recognition import PlaceRecognizer
from ..map.keyframes import motion_between
from ..map.visual_map import VisualMap
from .pose_graph import PoseGraph

_RECENT = 5  # newest keyframes, which are never loop candidates
_OUTSTANDING = 2.0  # sigmas above the similarity of unrelated keyframes
_FEWEST = 5  # keyframes needed for the usual similarity
_CHI2 = 22.5  # 99.9 % of six degrees of freedom
_DRIFT_RATIO = 0.05  # of the path length: a loop with more drift is rejected
_SIGMAS = 3.0
_CHI2_TURN = 16.3  # 99.9 % of three degrees of freedom
_ALIKE = 16.0  # steps, about a second, in which a gyro's bias or wheels err alike


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Query:
    """A new keyframe with its depth image."""

    keyframe_id: int
    depth_m: NDArray[np.float32] | None  # (H, W) [m], None: no depth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopClosure:
    """A loop: the edge from an old to a new keyframe, and the new one's pose by it."""

    edge: Edge
    T_local_base: Transform  # of the new keyframe, by the old part of the map

    @property
    def keyframe_id(self) -> int:
        """Return the new keyframe."""
        return self.edge.second


class LoopDetector:
    """Checks one keyframe at a time: first by appearance, then by geometry."""

    def __init__(
        self, visual_map: VisualMap, recognizer: PlaceRecognizer, graph: PoseGraph
    ) -> None:
        self._map, self._recognizer, self._graph = visual_map, recognizer, graph
        self._hypothesis: LoopClosure | None = None

    def candidate(self, query: Query) -> int | None:
        """Return the unconnected keyframe that is exceptionally similar to the new one.

        Depth has to verify it: far landmarks look about the same after a turn and a shift. Only
        where no keyframe of the map has depth, loops do without.
        """
        keyframes = self._map.keyframes
        new = keyframes[query.keyframe_id]
        deep = [k for k in keyframes.ids if not keyframes[k].is_monocular]
        if deep and new.is_monocular:
            return None
        known = set(keyframes.covisible(new.landmark_ids, limit=len(keyframes)))
        known |= set(keyframes.ids[-_RECENT:])
        far = [k for k in deep or keyframes.ids if k not in known]
        alike = self._recognizer.places.alike(new.features.descriptors, far)
        if not alike:
            return None
        ratios = np.array([likeness.ratio for likeness in alike])
        usual = float(np.median(ratios))
        sigma = spread(ratios - usual)
        if len(alike) >= _FEWEST and ratios[0] < usual + _OUTSTANDING * sigma:
            return None
        return alike[0].place_id

    def check(self, query: Query, candidate: int) -> list[LoopClosure]:
        """Return the loops that two keyframes agree on: this one's and an earlier one's."""
        new = self._map.keyframes[query.keyframe_id]
        fix = self._recognizer.recognize(candidate, new.features, query.depth_m)
        if fix is None:
            return []
        loop = self._loop(candidate, query.keyframe_id, fix)
        if not self._is_plausible(loop):
            return []
        earlier, self._hypothesis = self._hypothesis, loop
        if earlier is None or not self._is_there(earlier):
            return []
        if not self._agree(earlier, loop):
            return []
        self._hypothesis = None
        return [earlier, loop]

    def _is_there(self, loop: LoopClosure) -> bool:
        """Tell whether the map still has both keyframes of a loop."""
        return loop.edge.first in self._graph and loop.edge.second in self._graph

    def is_news(self, loop: LoopClosure) -> bool:
        """Tell whether a loop moves its keyframe by more than its uncertainty."""
        T_local_base = self._map.keyframes[loop.keyframe_id].T_local_base
        xi = se3.log(se3.inverse(T_local_base) @ loop.T_local_base)
        return float(xi @ np.linalg.solve(loop.edge.covariance, xi)) > _CHI2

    def _is_plausible(self, loop: LoopClosure) -> bool:
        """Tell whether drift explains what a loop differs by from odometry's turn and the path."""
        edge, covariance = loop.edge, loop.edge.covariance
        old, new = (self._map.keyframes[k] for k in (edge.first, edge.second))
        motion = motion_between(old, new)
        if motion is not None:
            off = se3.log(se3.inverse(motion.T_here_there) @ edge.T_first_second)[3:]
            spread = covariance[3:, 3:] + _ALIKE * motion.variance[1] * np.eye(3)
            if float(off @ np.linalg.solve(spread, off)) > _CHI2_TURN:
                return False
        way = self._graph.way(edge.first, edge.second)
        if way is None:
            return True
        T_error = se3.inverse(new.T_local_base) @ loop.T_local_base
        sigmas = np.sqrt(np.diag(covariance))
        turn_rad = _DRIFT_RATIO * way.turned_rad + _SIGMAS * way.sigma_rad
        shift_m = _DRIFT_RATIO * way.length_m + _SIGMAS * way.sigma_m + turn_rad * way.reach_m
        return se3.is_within(
            T_error,
            shift_m + _SIGMAS * sigmas[:3].max(),
            turn_rad + _SIGMAS * sigmas[3:].max(),
        )

    def _loop(self, old: int, new: int, fix: VisualFix) -> LoopClosure:
        T_old = self._map.keyframes[old].T_local_base
        T_local_base = fix.estimate.T_local_base
        T_first_second = se3.inverse(T_old) @ T_local_base
        edge = Edge(
            first=old,
            second=new,
            T_first_second=T_first_second,
            covariance=motion_covariance(T_first_second, fix.estimate.covariance),
            kind=EdgeKind.LOOP,
        )
        return LoopClosure(edge=edge, T_local_base=T_local_base)

    def _agree(self, earlier: LoopClosure, later: LoopClosure) -> bool:
        """Tell whether both loops imply the same motion between the two new keyframes."""
        T_first, T_second = (
            self._map.keyframes[loop.keyframe_id].T_local_base for loop in (earlier, later)
        )
        T_tracked = se3.inverse(T_first) @ T_second
        T_looped = se3.inverse(earlier.T_local_base) @ later.T_local_base
        xi = se3.log(se3.inverse(T_tracked) @ T_looped)
        carried = se3.carried(earlier.edge.covariance, se3.inverse(T_looped))
        covariance = motion_covariance(T_tracked, carried + later.edge.covariance)
        return float(xi @ np.linalg.solve(covariance, xi)) <= _CHI2
