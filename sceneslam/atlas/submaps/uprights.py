"""The vertical directions that hold submaps upright."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.graph import UPRIGHT_RAD, Upright
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.motion.tilt import upright
from sceneslam.types import se3
from sceneslam.types.se3 import Vector


def straightened(chain: Chain) -> list[Submap]:
    """Return the submaps of a whole run, their vertical directions without its usual tilt.

    Base is level most of the time: a sensor that is mounted askew has the same tilt everywhere.
    The tilt stays where it is that of base, as on a ramp.
    """
    submaps = list(chain.submaps)
    known = [node for node, submap in enumerate(submaps) if submap.up is not None]
    if not known:
        return submaps
    ups = np.array([submaps[node].up for node in known])
    level = ups @ upright(se3.identity(), np.median(ups, axis=0))[:3, :3].T
    if are_steady(np.array(chain.T_run_node)[known], level, ups):
        for node, up in zip(known, level, strict=True):
            submaps[node] = replace(submaps[node], up=up)
    return submaps


def are_steady(
    T_map_node: NDArray[np.float64], ups: NDArray[np.float64], others: NDArray[np.float64]
) -> bool:
    """Tell whether directions (N, 3) in nodes (N, 4, 4) change in the map no more than others.

    A direction that is not vertical turns with base. Changes are summed from each node to the
    next, as modules drift in tilt over many.
    """
    changes, least = (
        np.diff(np.einsum("nij,nj->ni", T_map_node[:, :3, :3], each), axis=0)
        for each in (ups, others)
    )
    return bool((changes**2).sum() <= (least**2).sum() + UPRIGHT_RAD**2)


def usual_up(submaps: Sequence[Submap], T_map_node: NDArray[np.float64], up_node: Vector) -> Vector:
    """Return the usual vertical direction (3,) in the map; `up_node` (3,) if none was measured."""
    ups = [up_node if submap.up is None else submap.up for submap in submaps]
    up = np.median(np.einsum("nij,nj->ni", T_map_node[:, :3, :3], ups), axis=0)
    return np.asarray(up / np.linalg.norm(up))


def are_on_floor(
    edges: Sequence[Edge], T_map_node: NDArray[np.float64], up_node: Vector, up_map: Vector
) -> bool:
    """Tell whether motions lie in the floor of their nodes (N, 4, 4) as well as in a level one.

    `up_node` (3,) is the normal of the first, in every node, `up_map` that of the second. A robot
    moves in the plane that it stands on; what is carried by hand tilts whichever way it moves.
    """
    motions = [edge for edge in edges if edge.kind is EdgeKind.MOTION]
    T_first_second = np.array([motion.T_first_second for motion in motions]).reshape(-1, 4, 4)
    firsts = T_map_node[[motion.first for motion in motions], :3, :3]
    steps = T_first_second[:, :3, 3]
    ups = 0.5 * (up_node + T_first_second[:, :3, :3] @ up_node)
    off_floor_m = (steps * ups).sum(axis=1)
    climbed_m = np.einsum("i,nij,nj->n", up_map, firsts, steps)
    uneven_m = UPRIGHT_RAD * np.linalg.norm(steps, axis=1)
    return bool((off_floor_m**2).sum() <= (climbed_m**2 + uneven_m**2).sum())


def uprights(
    submaps: Sequence[Submap], T_map_node: NDArray[np.float64], nodes: Sequence[int]
) -> list[Upright]:
    """Return the vertical directions of `nodes`, in one map; the first one gives that of the map.

    Those of the submaps are `straightened`.
    """
    ups = {node: up for node in nodes if (up := submaps[node].up) is not None}
    if not ups:
        return []
    first, up_first = next(iter(ups.items()))
    up_map = T_map_node[first, :3, :3] @ up_first
    return [Upright(node=node, up_node=up, up_map=up_map) for node, up in ups.items()]
