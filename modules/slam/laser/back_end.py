"""The back end: a pose graph over the keyframes, and the loops that correct it."""

from __future__ import annotations

from dataclasses import dataclass, field

from .keyframes import Keyframes
from .loop_closure import LoopCloser
from .pose_graph import Edge, PoseGraph, optimise


@dataclass(slots=True)
class BackEnd:
    """Takes keyframes one by one, and moves all of them when a loop closes."""

    keyframes: Keyframes
    closer: LoopCloser
    graph: PoseGraph = field(default_factory=PoseGraph)
    revision: int = field(default=0, init=False)

    def take(self) -> bool:
        """Take the newest keyframe; tell whether poses were corrected for it."""
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
        loops = self.closer.close(number)
        for edge in loops:
            self.graph.add(edge)
        if not loops:
            return False
        self.keyframes.move(self.graph.smooth(self.keyframes.poses))
        self.revision += 1
        return True

    def finish(self) -> None:
        """Fit all edges once more, from the poses as they are."""
        if self.revision:
            self.keyframes.move(optimise(self.graph.edges, self.keyframes.poses))
