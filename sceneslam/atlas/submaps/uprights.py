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
from sceneslam.types import planar, se3
from sceneslam.types.planar import Matrix
from sceneslam.types.se3 import Transform, Vector

_UP = np.array([0.0, 0.0, 1.0])
_HEADINGS = 0.1**2  # rad^2: the tilt of modules drifts by 2 degrees, a third of such a spread
_CANCELLED = 1e-6  # the median of directions that cancel out, and its rounding
_HELD = np.array([1.0, 0.3, 0.3]) ** 2  # m, rad: a hand lifts and tilts, and walls do not show it


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
    up = _usual(np.einsum("nij,nj->ni", T_map_node[:, :3, :3], ups))
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


def floor_normal(
    edges: Sequence[Edge], T_map_node: NDArray[np.float64], submaps: Sequence[Submap]
) -> Vector | None:
    """Return the normal (3,) in base of the floor that motions lie in, None if carried by hand.

    It is base's own z or, where another axis is the steadier one, that: the axis that base turns
    about. Who drives straight, mounted with a roll, does not leave the plane of x and y either.
    """
    normals = _UP, turning_axis(T_map_node)
    ups, axes = (np.tile(normal, (len(T_map_node), 1)) for normal in normals)
    for normal in normals if are_steady(T_map_node, ups, axes) else reversed(normals):
        if are_on_floor(edges, T_map_node, normal, usual_up(submaps, T_map_node, normal)):
            return normal
    return None


def mount(up_base: Vector) -> Transform:
    """Return the roll and pitch (4, 4) of a base in which `up_base` (3,) points upwards."""
    T = upright(se3.identity(), up_base)
    return se3.from_xy_yaw(0.0, 0.0, -se3.yaw_rad(T)) @ T


def turning_axis(T_map_node: NDArray[np.float64]) -> Vector:
    """Return the direction (3,) in nodes (N, 4, 4) that changes least in the map.

    It is the map's own z, as it usually is in them, if their headings hardly differ. It is that of
    the nodes where they usually lie on their side.
    """
    x, y, z = _usual(T_map_node[:, 2, :3])
    if abs(z) < _CANCELLED:
        return _UP
    mean = T_map_node[:, :3, :3].mean(axis=0)
    spread = np.eye(3) - mean.T @ mean  # u' spread u: variance of a direction u in the map
    pulled = _HEADINGS * np.array([x, y]) / z - spread[:2, 2]
    axis = np.append(np.linalg.solve(spread[:2, :2] + _HEADINGS * np.eye(2), pulled), 1.0)
    return np.asarray(axis / np.linalg.norm(axis))


def _usual(directions: NDArray[np.float64]) -> Vector:
    """Return the median (3,) of directions (N, 3), the first one where they cancel out."""
    median = np.median(directions, axis=0)
    return np.asarray(directions[0] if np.linalg.norm(median) < _CANCELLED else median)


def tilt(T_map_node: NDArray[np.float64], submaps: Sequence[Submap], node: int) -> Transform:
    """Return the roll and pitch (4, 4) of a node against what is usually level in the map."""
    T_level_map = upright(se3.identity(), usual_up(submaps, T_map_node, _UP))
    T_level_node = T_level_map @ T_map_node[node]
    T_level_flat = planar.to_transform(planar.from_transform(T_level_node))
    return se3.from_parts((se3.inverse(T_level_flat) @ T_level_node)[:3, :3], np.zeros(3))


def by_hand(covariance: Matrix, T_level_node: Transform) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a node carried by hand from that in the plane (3, 3).

    Height and tilt are open. It is in the axes of the node, which has the `tilt` T_level_node.
    """
    level = planar.spatial_covariance(covariance, level=_HELD)
    return se3.carried(level, se3.inverse(T_level_node))


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
