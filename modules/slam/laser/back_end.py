"""The back end: a pose graph over the keyframes, corrected by loop closures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sceneslam.types.planar import between

from .keyframes import ScanKeyframes
from .loop_closure import ScanLoopCloser
from .pose_graph import ScanEdge, ScanPoseGraph, optimise

_FELT = np.array([5e-3, 5e-3, 2e-3])  # m, m, rad: smaller corrections are within the pose's noise


@dataclass(slots=True)
class LaserBackEnd:
    """Takes keyframes one by one, and corrects all of them when a loop closes."""

    keyframes: ScanKeyframes
    closer: ScanLoopCloser | None  # None: laser odometry without loop closure
    graph: ScanPoseGraph = field(default_factory=ScanPoseGraph)
    revision: int = field(default=0, init=False)

    def take(self) -> bool:
        """Process the newest keyframe; return whether poses were corrected."""
        number = len(self.keyframes) - 1
        frames = self.keyframes.frames
        if number > 0:
            self.graph.add(
                ScanEdge(
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
        before = frames[-1].T_local_base
        self.keyframes.move(self.graph.smooth(self.keyframes.poses))
        moved = np.abs(between(before, frames[-1].T_local_base))
        self.revision += bool((moved > _FELT).any())
        return True

    def finish(self) -> None:
        """Optimise all edges once more, starting from the current poses."""
        if any(edge.is_loop for edge in self.graph.edges):
            self.keyframes.move(optimise(self.graph.edges, self.keyframes.poses))
