"""Prune a map: remove submaps whose area, and views, later ones cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.saved_map import SavedMap
from sceneslam.atlas.places.floor_plan import join
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.submaps.chain import is_guessed
from sceneslam.graphs.edge import Edge
from sceneslam.types import planar
from sceneslam.views.placed_views import are_covered

_COVERED_RATIO = 0.95  # of a submap's walls, and of its free cells, shown by later submaps ...
_NEAR_M = 0.1  # ... two cells away, at most


def prune(saved: SavedMap) -> SavedMap:
    """Return the map without submaps that later ones of their piece show, too.

    The newest stay. Motions and loops through removed submaps are composed.
    """
    kept = list(range(len(saved.submaps)))
    for node in range(len(saved.submaps)):
        others = [
            other for other in kept if other > node and saved.pieces[other] == saved.pieces[node]
        ]
        if others and _is_covered(saved, node, others):
            kept.remove(node)
    edges = list(saved.edges)
    for node in sorted(set(range(len(saved.submaps))) - set(kept)):
        edges = _without(edges, node)
    return replace(saved, edges=tuple(edges)).of(kept)


def _is_covered(saved: SavedMap, node: int, others: list[int]) -> bool:
    """Tell whether others show a submap's walls, what is free in it, and as much as its views."""
    if not are_covered(saved.views_of([node]), saved.views_of(others)).all():
        return False
    plan, plane = saved.submaps[node].plan, saved.plane
    walls, free = plan.points.astype(np.float64), plan.free_points()
    ground = np.concatenate([walls, free])
    if not len(ground):
        return True
    reach_m = float(np.linalg.norm(np.ptp(ground, axis=0)))
    away_m = np.linalg.norm(plane[others, :2] - plane[node, :2], axis=1)
    near = [other for other, far_m in zip(others, away_m, strict=True) if far_m <= 2 * reach_m]
    shown = join(
        [(planar.between(plane[node], plane[other]), saved.submaps[other].plan) for other in near]
    )
    if not len(shown):
        return not len(walls) and _is_most(shown.is_free(free))
    field = PlanField(shown)
    is_wall = field.nearest(walls).distance_m <= _NEAR_M
    return _is_most(is_wall) and _is_most(field.nearest(free).is_known)


def _is_most(shown: NDArray[np.bool_]) -> bool:
    return not len(shown) or bool(shown.mean() >= _COVERED_RATIO)


def _without(edges: Sequence[Edge], node: int) -> list[Edge]:
    """Return the edges without a node; those to it are composed, so that its neighbours connect.

    All its neighbours are linked with the one whose edge is the most certain: a motion if one was
    measured, else a loop. What measures nothing comes last, and stands in no loop's way.
    """
    ends = [edge for edge in edges if node in (edge.first, edge.second)]
    left = [edge for edge in edges if node not in (edge.first, edge.second)]
    own = [edge if edge.first == node else edge.turned() for edge in ends]
    own.sort(key=lambda edge: (*_rank(edge), float(np.trace(edge.covariance))))
    for edge in own[1:]:
        bridge = own[0].turned().then(edge)
        pair = {bridge.first, bridge.second}
        same = [one for one in left if {one.first, one.second} == pair]
        if len(pair) == 2 and all(_rank(bridge) < _rank(one) for one in same):
            left.append(bridge if bridge.first < bridge.second else bridge.turned())
    return left


def _rank(edge: Edge) -> tuple[bool, bool]:
    """Return a key that sorts edges: measured motions, loops, and what nothing measured."""
    return is_guessed(edge.covariance), edge.is_loop
