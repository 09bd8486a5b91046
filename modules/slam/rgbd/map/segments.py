"""Map segments without a measured connection, begun after tracking was lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import unknown_motion
from sceneslam.types.se3 import Transform

from ..loops.pose_graph import PoseGraph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Guess:
    """The assumed pose at which a segment began."""

    T_local_base: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order [m, rad], base frame


class Segments:
    """The segments not yet connected to the first one, each by one of its keyframes."""

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._guesses: dict[int, _Guess] = {}

    @property
    def are_many(self) -> bool:
        """Tell whether there is more than one segment."""
        return bool(self._guesses)

    def begin(self, keyframe_id: int, T_local_base: Transform, *, lost_s: float) -> None:
        """Begin a segment by a keyframe at an assumed pose, after `lost_s` without a pose."""
        guess = _Guess(T_local_base=T_local_base.copy(), covariance=unknown_motion(lost_s))
        self._guesses[keyframe_id] = guess

    def replace(self, gone: int, heir: int | None) -> None:
        """Replace a removed keyframe by another one of its segment; None: it was the last one."""
        guess = self._guesses.pop(gone, None)
        if guess is not None and heir is not None:
            self._guesses[heir] = guess

    def update(self) -> None:
        """Update after a correction, which may have joined segments."""
        first = self._graph.connected(self._graph.ids[0])
        self._guesses = {k: guess for k, guess in self._guesses.items() if k not in first}

    def around(self, keyframe_id: int) -> set[int]:
        """Return the keyframes of a keyframe's segment."""
        return self._graph.connected(keyframe_id)

    def covariance(
        self, segment: set[int], T_local_base: Transform, measured: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Return the covariance (6, 6) of a pose in a segment with an assumed start.

        None for a segment that is connected to the first one.
        """
        guess = next((guess for k, guess in self._guesses.items() if k in segment), None)
        if guess is None:
            return None
        T_start_base = se3.inverse(guess.T_local_base) @ T_local_base
        return se3.carried(guess.covariance, se3.inverse(T_start_base)) + measured
