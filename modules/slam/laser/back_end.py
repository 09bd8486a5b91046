"""The back end: a pose graph over the keyframes, corrected by loop closures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sceneslam.types.planar import between

from .keyframes import Keyframes
from .loop_closure import LoopCloser
from .pose_graph import Edge, PoseGraph, optimise

_FELT = np.array([5e-3, 5e-3, 2e-3])  # m, m, rad: smaller corrections are within the pose's noise


@dataclass(slots=True)
class BackEnd:
    """Takes keyframes one by one, and corrects all of them when a loop closes."""

    keyframes: Keyframes
    closer: LoopCloser | None  # None: laser odometry without loop closure
    graph: PoseGraph = field(default_factory=PoseGraph)
    revision: int = field(default=0, init=False)

    def take(self) -> bool:
        """Take the newest keyframe; return whether poses were corrected."""
        number = len(self.keyframes) - 1
        frames = self.keyframes.frames
        if number > 0:
            self.graph.add(
                Edge(
                    first=number - 1,
                    second=number,
                    T_first_second=frames[number].T_prev_curr,
                    covariance=frames[number].covariance,
                    is_loop=False,
                )
            )
        loops = [] if self.closer is None else self.closer.close(number)
        for edge in loops:
            self.graph.add(edge)
        if not loops:
            return False
        told = frames[-1].T_local_base
        self.keyframes.move(self.graph.smooth(self.keyframes.poses))
        moved = np.abs(between(told, frames[-1].T_local_base))
        self.revision += bool((moved > _FELT).any())
        return True

    def finish(self) -> None:
        """Optimise all edges once more, starting from the current poses."""
        if any(edge.is_loop for edge in self.graph.edges):
            self.keyframes.move(optimise(self.graph.edges, self.keyframes.poses))
