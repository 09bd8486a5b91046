"""Join the pieces of one or two maps where they show the same place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import join
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.submaps.graph import Solved, consistent, on_floor, solve
from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.atlas.submaps.uprights import by_hand, floor_normal, tilt, uprights
from sceneslam.graphs.edge import Edge
from sceneslam.types import planar, se3
from sceneslam.views.landmark_registration import recognize
from sceneslam.views.placed_views import PlacedViews

_AROUND = 1  # neighbouring submaps on either side that are searched together with one
_LOOPS_MIN = 2  # agreeing loops, as a single one may come from a similar place


def side_by_side(first: SavedMap, second: SavedMap) -> SavedMap:
    """Return both maps in one, the second's pieces and runs after the first's."""
    count, pieces = len(first.submaps), int(first.pieces.max(initial=-1)) + 1
    later = [replace(submap, run=submap.run + first.runs) for submap in second.submaps]
    return SavedMap(
        submaps=(*first.submaps, *later),
        T_map_node=np.concatenate([first.T_map_node, second.T_map_node]),
        pieces=np.concatenate([first.pieces, second.pieces + pieces]),
        edges=(*first.edges, *(edge.shifted(count) for edge in second.edges)),
    )


def join_pieces(saved: SavedMap) -> SavedMap:
    """Return the map with every piece joined to the first one in which it is recognized.

    A piece of which fewer than two submaps are recognized stays apart.
    """
    saved, target = _renumbered(saved), 0
    while target <= saved.pieces.max(initial=-1):
        found = None
        for piece in range(target + 1, int(saved.pieces.max()) + 1):
            found = _joined(saved, target, piece)
            if found is not None:
                saved = _renumbered(found)
                break
        target = target + 1 if found is None else 0  # what is larger now may be recognized
    return saved


def _joined(saved: SavedMap, target: int, piece: int) -> SavedMap | None:
    """Return the map with a piece joined to another, None if it is not recognized there."""
    own = saved.nodes(piece)
    loops = [*_loops_by_walls(saved, target, own), *_loops_by_views(saved, target, own)]
    drift = PathDrift.along(saved.edges, len(saved.submaps))
    agreeing = [loops[index] for index in consistent(loops, saved.T_map_node, drift)]
    if len(agreeing) < _LOOPS_MIN:
        return None
    nodes = np.array(saved.T_map_node)
    seed = agreeing[0]
    at_seed = nodes[seed.first] @ seed.T_first_second
    nodes[own] = at_seed @ se3.inverse(nodes[seed.second]) @ nodes[own]
    solved = _solve(saved, nodes, saved.nodes(target), own, agreeing)
    if len(solved.accepted) < _LOOPS_MIN:
        return None
    pieces = np.where(saved.pieces == piece, target, saved.pieces)
    edges = *saved.edges, *(agreeing[index] for index in solved.accepted)
    joined = replace(saved, T_map_node=solved.T_map_node, pieces=pieces, edges=edges)
    return joined.without_misfits()


def _loops_by_walls(saved: SavedMap, piece: int, own: Sequence[int]) -> list[Edge]:
    """Return loops from a piece to the submaps `own` of another piece, by their walls."""
    plane, target = saved.plane, Recognizer.of(saved.plan(piece))
    if target is None:
        return []
    part = saved.of(own)
    is_held = any(
        floor_normal(each.edges, each.T_map_node, each.submaps) is None
        for each in (part, saved.of(saved.nodes(piece)))
    )
    found = []
    for row, node in enumerate(own):
        around = own[max(row - _AROUND, 0) : row + _AROUND + 1]
        near = [index for index in around if saved.submaps[index].run == saved.submaps[node].run]
        query = join([(planar.between(plane[node], plane[i]), saved.submaps[i].plan) for i in near])
        match = target.locate(query)
        if match is None:
            continue
        T_map_node = saved.standing(planar.to_transform(match.T_target_query), piece)
        covariance = on_floor(match.covariance)
        if is_held:
            T_level_node = tilt(part.T_map_node, part.submaps, row)
            T_map_node = T_map_node @ T_level_node
            covariance = by_hand(match.covariance, T_level_node)
        found.append(saved.loop_to(T_map_node, covariance, node, piece=piece))
    return found


def _loops_by_views(saved: SavedMap, piece: int, own: Sequence[int]) -> list[Edge]:
    """Return the same by what a camera saw, a loop per view that was recognized."""
    known = PlacedViews(saved.views(piece))
    return [
        saved.loop_to(
            found[1].T_map_cam @ se3.inverse(view.T_submap_cam),
            se3.carried(found[1].covariance, view.T_submap_cam),
            node,
            piece=piece,
        )
        for node in own
        for view in saved.submaps[node].views
        if (found := recognize(known, view.landmarks)) is not None
    ]


def _solve(
    saved: SavedMap,
    nodes: NDArray[np.float64],
    around: Sequence[int],
    own: Sequence[int],
    loops: Sequence[Edge],
) -> Solved:
    """Return the optimised nodes; those beside the two pieces stay."""
    moving = saved.moving([*around, *own])
    is_upright = any(saved.submaps[node].up is not None for node in around)
    return solve(
        nodes,
        moving.motions,
        loops,
        fixed=moving.fixed,
        loose=moving.loose,
        places=moving.loops,
        uprights=uprights(saved.submaps, nodes, [*around, *own]) if is_upright else (),
    )


def _renumbered(saved: SavedMap) -> SavedMap:
    _, pieces = np.unique(saved.pieces, return_inverse=True)
    return replace(saved, pieces=np.asarray(pieces, np.int64))
