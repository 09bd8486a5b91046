"""Parts of the map that nothing measured connects: where a lost camera began anew."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from .pose_graph import Edge, PoseGraph

_WALK_M_PER_S, _TURN_RAD_PER_S = 1.0, 1.0  # deviations of what a camera may do while it is lost


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Guess:
    """Where a segment was begun, which nobody measured."""

    T_local_base: Transform
    covariance: NDArray[np.float64]  # (6, 6) of se3.log order [m, rad], base frame


class Segments:
    """The segments that are not joined to the first one yet, by a keyframe of each."""

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._guesses: dict[int, _Guess] = {}

    @property
    def are_many(self) -> bool:
        """Tell whether there are any but the first."""
        return bool(self._guesses)

    def begin(self, keyframe_id: int, T_local_base: Transform, *, lost_s: float) -> None:
        """Take a keyframe that was put at a guess, after so long without a pose."""
        sigmas = lost_s * np.repeat([_WALK_M_PER_S, _TURN_RAD_PER_S], 3)
        guess = _Guess(T_local_base=T_local_base.copy(), covariance=np.diag(sigmas**2))
        self._guesses[keyframe_id] = guess

    def replace(self, gone: int, heir: int) -> None:
        """Let another keyframe of its segment stand for one that is forgotten."""
        if gone in self._guesses:
            self._guesses[heir] = self._guesses.pop(gone)

    def update(self) -> None:
        """Follow a correction, which may have joined segments."""
        first = self._graph.connected(self._graph.ids[0])
        self._guesses = {k: guess for k, guess in self._guesses.items() if k not in first}

    def around(self, keyframe_id: int) -> set[int]:
        """Return the keyframes of the segment that one is of."""
        return self._graph.connected(keyframe_id)

    def covariance(
        self, segment: set[int], T_local_base: Transform, measured: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """Return the covariance (6, 6) of a pose measured in a segment that hangs on a guess.

        None for a segment that does not.
        """
        guess = next((guess for k, guess in self._guesses.items() if k in segment), None)
        if guess is None:
            return None
        T_start_base = se3.inverse(guess.T_local_base) @ T_local_base
        begun = Edge(start=0, end=1, T_start_end=se3.identity(), covariance=guess.covariance)
        way = Edge(start=1, end=2, T_start_end=T_start_base, covariance=measured)
        return begun.then(way).covariance
