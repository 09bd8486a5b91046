"""Loop closure to earlier pieces of a run: nothing tells how they lie to the piece that grows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import join
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.submaps.loop_query import LoopQuery
from sceneslam.graphs.edge import Edge
from sceneslam.types import planar
from sceneslam.types.errors import InputError

_LARGEST = 8  # earlier pieces that are searched, by their submaps: each takes a tenth of a second
_SPAN = 3  # newest submaps that are compared, 7.5 m of path: as a run with a loaded map


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Piece:
    """An earlier piece as a map."""

    first: int  # submap of the run
    map: SavedMap
    walls: Recognizer | None  # None: it shows none, or is too large to draw

    def loop_to(self, query: LoopQuery) -> Edge | None:
        """Return the loop to the submap `query.second` if the newest are recognized here."""
        newest = range(max(query.start, query.second - _SPAN + 1), query.second + 1)
        placed = [
            (planar.between(query.plane[query.second], query.plane[one]), query.submaps[one].plan)
            for one in newest
        ]
        try:
            match = None if self.walls is None else self.walls.locate(join(placed))
        except InputError:  # of a plan that is too large
            return None
        if match is None:
            return None
        T_map_level = self.map.standing(planar.to_transform(match.T_target_query))
        T_map_node = T_map_level @ query.T_level_second
        covariance = query.spatial(match.covariance)
        return self.map.loop_to(T_map_node, covariance, query.second, first=self.first)


class PieceLoops:
    """Finds the newest submaps in earlier pieces, wherever that is."""

    def __init__(self) -> None:
        self._pieces: dict[tuple[int, int], _Piece] = {}

    def forget(self, count: int) -> None:
        """Forget all submaps but the first `count`."""
        self._pieces = {ends: one for ends, one in self._pieces.items() if ends[1] <= count}

    def loops_to(self, query: LoopQuery, T_map_node: NDArray[np.float64]) -> list[Edge]:
        """Return the loop to a submap, none if more than one place fits.

        `T_map_node` (N, 4, 4) are the submaps as they were solved last.
        """
        starts = [start for start in query.starts if start <= query.second]
        by_size = sorted(pairwise(starts), key=lambda ends: ends[0] - ends[1])
        largest = by_size[:_LARGEST]
        self._pieces = {ends: one for ends, one in self._pieces.items() if ends in largest}
        for ends in largest:  # where its submaps lie in a piece is not updated
            if ends not in self._pieces:
                self._pieces[ends] = _piece(ends, query, T_map_node)
        loops = [self._pieces[ends].loop_to(query) for ends in largest]
        found = [loop for loop in loops if loop is not None]
        return found if len(found) == 1 else []


def _piece(ends: tuple[int, int], query: LoopQuery, T_map_node: NDArray[np.float64]) -> _Piece:
    start, end = ends
    own = slice(start, end)
    submaps = tuple(query.submaps[own])
    piece = SavedMap(
        submaps=submaps,
        T_map_node=T_map_node[own],
        pieces=np.zeros(len(submaps), np.int64),
        edges=tuple(motion.shifted(-start) for motion in query.motions[start : end - 1]),
    )
    try:
        walls = Recognizer.of(piece.plan())
    except InputError:
        walls = None
    return _Piece(first=start, map=piece, walls=walls)
