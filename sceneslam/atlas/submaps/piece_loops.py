"""Loop closure to earlier pieces of a run: nothing tells how they lie to the piece that grows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import FloorPlan, join
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.places.registration import PlanRegistration
from sceneslam.atlas.submaps.graph import on_floor
from sceneslam.atlas.submaps.loop_query import LoopQuery
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar
from sceneslam.types.errors import InputError
from sceneslam.types.planar import Planar

_LARGEST = 8  # earlier pieces that are searched, by their submaps: each takes a tenth of a second
_SPAN = 3  # newest submaps that are compared, 7.5 m of path: as a run with a loaded map


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Piece:
    """The plan of an earlier piece, and where its submaps lie in it."""

    first: int
    plane: NDArray[np.float64]  # (K, 3)
    recognizer: Recognizer | None  # None: it shows no walls, or is too large to draw


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
        if len(starts) == 1:
            return []
        newest = range(max(starts[-1], query.second - _SPAN + 1), query.second + 1)
        placed = [
            (planar.between(query.plane[query.second], query.plane[one]), query.submaps[one].plan)
            for one in newest
        ]
        plan, found = join(placed), list[Edge]()
        by_size = sorted(pairwise(starts), key=lambda ends: ends[0] - ends[1])
        largest = by_size[:_LARGEST]
        self._pieces = {ends: one for ends, one in self._pieces.items() if ends in largest}
        for ends in largest:
            piece = self._piece(ends, query, T_map_node)
            match = None if piece.recognizer is None else piece.recognizer.locate(plan)
            if match is not None:
                found.append(_edge(piece, match, query.second))
        return found if len(found) == 1 else []

    def _piece(
        self, ends: tuple[int, int], query: LoopQuery, T_map_node: NDArray[np.float64]
    ) -> _Piece:
        """Return a piece; where its submaps lie is not updated."""
        if ends not in self._pieces:
            own = slice(*ends)
            plane = planar.from_transforms(T_map_node[own])
            plans = [submap.plan for submap in query.submaps[own]]
            self._pieces[ends] = _Piece(
                first=ends[0],
                plane=plane,
                recognizer=_recognizer(list(zip(plane, plans, strict=True))),
            )
        return self._pieces[ends]


def _recognizer(placed: list[tuple[Planar, FloorPlan]]) -> Recognizer | None:
    try:
        plan = join(placed)
    except InputError:
        return None
    return Recognizer(PlanField(plan)) if len(plan) else None


def _edge(piece: _Piece, match: PlanRegistration, second: int) -> Edge:
    """Return the loop from the nearest submap of a piece."""
    away_m = np.hypot(*(piece.plane - match.T_target_query)[:, :2].T)
    nearest = int(np.argmin(away_m))
    return Edge(
        first=piece.first + nearest,
        second=second,
        T_first_second=planar.to_transform(
            planar.between(piece.plane[nearest], match.T_target_query)
        ),
        covariance=on_floor(match.covariance),
        kind=EdgeKind.LOOP,
    )
