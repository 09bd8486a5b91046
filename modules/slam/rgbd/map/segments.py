"""Map segments without a measured connection, begun after tracking was lost."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import unknown_motion
from sceneslam.types.se3 import Transform

from ..loops.pose_graph import PoseGraph
from .keyframes import Keyframe


class Segments:
    """The segments not yet connected to the first one, each by one of its keyframes."""

    def __init__(self, graph: PoseGraph, keyframes: Mapping[int, Keyframe]) -> None:
        self._graph, self._keyframes = graph, keyframes
        # By keyframe the covariance (6, 6) of its assumed pose, of se3.log order [m, rad], in base.
        self._guesses: dict[int, NDArray[np.float64]] = {}

    @property
    def are_many(self) -> bool:
        """Tell whether there is more than one segment."""
        return bool(self._guesses)

    def begin(self, keyframe_id: int, *, lost_s: float) -> None:
        """Begin a segment by a keyframe at an assumed pose, after `lost_s` without a pose."""
        self._guesses[keyframe_id] = unknown_motion(lost_s)

    def replace(self, gone: int, heir: int | None, T_heir_gone: Transform) -> None:
        """Replace a removed keyframe by another one of its segment; None: it was the last one."""
        guess = self._guesses.pop(gone, None)
        if guess is not None and heir is not None:
            self._guesses[heir] = se3.carried(guess, T_heir_gone)

    def update(self) -> None:
        """Update after loops, which may have joined segments."""
        first = self._graph.connected(self._graph.ids[0])
        self._guesses = {k: guess for k, guess in self._guesses.items() if k not in first}

    def covariance(
        self, segment: set[int], T_local_base: Transform, measured: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Return the covariance (6, 6) of a pose in a segment with an assumed start.

        None for a segment that is connected to the first one.
        """
        start = next((k for k in self._guesses if k in segment), None)
        if start is None:
            return None
        T_base_start = se3.inverse(T_local_base) @ self._keyframes[start].T_local_base
        return se3.carried(self._guesses[start], T_base_start) + measured
