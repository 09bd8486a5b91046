"""The pose graph: submaps of all modules and runs, and the measured motions between them.

Wrong loops are rejected in two steps: only the largest pairwise consistent set is used (Mangelson
et al., "Pairwise consistent measurement set maximization", ICRA 2018), and its loops are weighed by
graduated non-convexity (Yang et al., RA-L 2020), which can still reject each of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.graphs.edge import Edge
from sceneslam.graphs.factors import TO_GTSAM, factor_of, noise_of
from sceneslam.types import planar, se3
from sceneslam.types.planar import Matrix

_CHI2_6 = 16.81  # chi-square with 6 degrees of freedom, 99th percentile
_FIXED = np.repeat([1e-4, 1e-5], 3)  # m, rad
_LOOSE = np.array([10.0, 10.0, 1.0, 0.05, 0.05, 3.0])  # m, rad: any loop moves it
_FLOOR = np.array([0.05, 0.02, 0.02]) ** 2  # m, rad: height and tilt between places of one floor
_TILT_RAD = 0.04  # that modules drift in pitch along a corridor, before gravity corrects them
UPRIGHT_RAD = 0.01  # half a degree: of gyro and gravity, and as floors are uneven
_HUBER_SIGMAS = 1.345  # 95 % efficiency relative to least squares, without outliers
_ROUNDS = 10  # in which the loops that fit worst are left out
_STEPS, _GAIN_RATIO = 20, 1e-3  # of a solution while the run goes on: its cost falls no further
_VAIN = 50  # starts in a row without a larger clique
LOADED = -1  # node of a loaded map


def on_floor(covariance: Matrix) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a motion on one floor from that in the plane (3, 3)."""
    return planar.spatial_covariance(covariance, level=_FLOOR)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Upright:
    """The measured vertical direction at a node."""

    node: int
    up_node: NDArray[np.float64]  # (3,), a unit vector in the node's frame
    up_map: NDArray[np.float64]  # (3,), the same in the map


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solved:
    """The graph after optimisation."""

    T_map_node: NDArray[np.float64]  # (N, 4, 4)
    accepted: list[int]  # indices of the accepted loops


def solve(
    T_map_node: NDArray[np.float64],
    motions: Sequence[Edge],
    loops: Sequence[Edge],
    *,
    fixed: Sequence[int],
    loose: Sequence[int],
    places: Sequence[Edge] = (),
    uprights: Sequence[Upright] = (),
) -> Solved:
    """Return the poses (N, 4, 4) that best fit the motions and the accepted loops.

    `fixed` nodes stay; `loose` ones have a weak prior, so that loops to others move them.
    `places` are loops that are known better, from a run that was found there again and again, or
    from an earlier solution: at the end none is rejected, but one that is far off weighs less.
    `uprights` hold roll and pitch. Every node must be connected to one that is fixed or loose. The
    result is deterministic.
    """
    import gtsam

    if not loops and not places and not uprights:
        return Solved(T_map_node=T_map_node, accepted=[])
    graph, values = _problem(T_map_node, motions, uprights)
    poses = [gtsam.Pose3(T) for T in T_map_node]
    noise = gtsam.noiseModel.Diagonal.Sigmas(_FIXED[TO_GTSAM])
    for number in fixed:
        graph.add(gtsam.PriorFactorPose3(number, poses[number], noise))
    slack = gtsam.noiseModel.Diagonal.Sigmas((_LOOSE if len(fixed) else _FIXED)[TO_GTSAM])
    for number in loose:
        graph.add(gtsam.PriorFactorPose3(number, poses[number], slack))
    measured = gtsam.NonlinearFactorGraph(graph)
    trusted = list(range(graph.size()))
    for edge in (*loops, *places):
        graph.add(factor_of(edge))
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers(trusted)
    optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
    optimizer.setInlierCostThresholds(0.5 * _CHI2_6)
    result = optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[len(trusted) :]
    accepted = np.flatnonzero(weights[: len(loops)] > 0.5).tolist()
    if places:
        for edge in places:
            measured.add(factor_of(edge, _HUBER_SIGMAS))
        for index in accepted:
            measured.add(factor_of(loops[index]))
        result = gtsam.LevenbergMarquardtOptimizer(measured, result).optimize()
    solved = _nodes(result, len(poses))
    solved[list(fixed)] = T_map_node[list(fixed)]
    return Solved(T_map_node=solved, accepted=accepted)


def connected(nodes: Sequence[int], edges: Sequence[Edge]) -> list[list[int]]:
    """Return the parts of `nodes` that edges connect, each as it was reached from its first."""
    neighbours: dict[int, list[int]] = {node: [] for node in nodes}
    for edge in edges:
        if edge.first in neighbours and edge.second in neighbours:
            neighbours[edge.first].append(edge.second)
            neighbours[edge.second].append(edge.first)
    parts, reached = list[list[int]](), set[int]()
    for node in nodes:
        if node in reached:
            continue
        part = [node]
        reached.add(node)
        for member in part:
            near = [other for other in neighbours[member] if other not in reached]
            reached.update(near)
            part += dict.fromkeys(near)
        parts.append(part)
    return parts


def settle(
    T_map_node: NDArray[np.float64],
    motions: Sequence[Edge],
    loops: Sequence[Edge],
    uprights: Sequence[Upright] = (),
) -> Solved:
    """Return the same for a run that goes on, whose first node stays, from its last solution.

    Loops that fit worst are left out, and it is solved again. Other threads run between two steps:
    gtsam lets none run within one, nor within the optimizer of `solve`.
    """
    import gtsam

    accepted, nodes = list(range(len(loops))), T_map_node
    noise = gtsam.noiseModel.Diagonal.Sigmas(_FIXED[TO_GTSAM])
    for _ in range(_ROUNDS):
        graph, values = _problem(nodes, motions, uprights)
        graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(T_map_node[0]), noise))
        for index in accepted:
            graph.add(factor_of(loops[index]))
        nodes = _stepped(gtsam.LevenbergMarquardtOptimizer(graph, values), len(nodes))
        misfits = [misfit(loops[index], nodes) for index in accepted]
        limit = max(_CHI2_6, 0.5 * max(misfits, default=0.0))  # a wrong loop bends those around it
        if all(each <= limit for each in misfits):
            break
        accepted = [
            index for index, misfit in zip(accepted, misfits, strict=True) if misfit <= limit
        ]
    return Solved(
        T_map_node=nodes, accepted=[index for index in accepted if fits(loops[index], nodes)]
    )


def _stepped(optimizer: Any, count: int) -> NDArray[np.float64]:
    """Return the nodes (N, 4, 4) after steps until the cost falls no further."""
    before = optimizer.error()
    for _ in range(_STEPS):
        optimizer.iterate()
        after = optimizer.error()
        if before - after <= _GAIN_RATIO * before:
            break
        before = after
    return _nodes(optimizer.values(), count)


def fits(edge: Edge, T_map_node: NDArray[np.float64]) -> bool:
    """Tell whether an edge agrees with the nodes (N, 4, 4)."""
    return misfit(edge, T_map_node) <= _CHI2_6


def off_nodes(edge: Edge, T_map_node: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far (6,) an edge is off the nodes (N, 4, 4), in se3.log order [m, rad]."""
    T_first_second = se3.inverse(T_map_node[edge.first]) @ T_map_node[edge.second]
    return np.asarray(se3.log(se3.inverse(T_first_second) @ edge.T_first_second))


def misfit(edge: Edge, T_map_node: NDArray[np.float64]) -> float:
    """Return the squared deviation of an edge from the nodes, over its covariance."""
    off = off_nodes(edge, T_map_node)
    return float(off @ np.linalg.solve(edge.covariance, off))


def _problem(
    T_map_node: NDArray[np.float64], motions: Sequence[Edge], uprights: Sequence[Upright]
) -> tuple[Any, Any]:
    """Return the graph without its loops, and the initial poses."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number, T in enumerate(T_map_node):
        values.insert(number, gtsam.Pose3(T))
    for edge in motions:
        graph.add(factor_of(edge))
    tilt = gtsam.noiseModel.Isotropic.Sigma(2, UPRIGHT_RAD)
    for one in uprights:
        directions = gtsam.Unit3(one.up_map), tilt, gtsam.Unit3(one.up_node)
        graph.add(gtsam.AttitudeFactorPose3(one.node, *directions))
    return graph, values


def _nodes(values: Any, count: int) -> NDArray[np.float64]:
    return np.array([values.atPose3(row).matrix() for row in range(count)])


def marginals(
    T_map_node: NDArray[np.float64],
    drifts: Mapping[tuple[int, int], NDArray[np.float64]],
    loops: Sequence[Edge],
) -> dict[int, NDArray[np.float64]]:
    """Return the marginal covariance (6, 6) of each node, in its axes.

    `drifts` are the covariances (6, 6) of the motions from node to node, in the axes of the second.
    A motion or loop from LOADED is measured from a fixed map.
    """
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    measured = [*drifts.items(), *(((loop.first, loop.second), loop.covariance) for loop in loops)]
    linked = sorted({node for ends, _ in measured for node in ends} - {LOADED})
    nodes = {node: gtsam.Pose3(T_map_node[node]) for node in linked}
    for node, pose in nodes.items():
        values.insert(node, pose)
    for (first, second), covariance in measured:
        noise = noise_of(covariance)
        if first == LOADED:
            graph.add(gtsam.PriorFactorPose3(second, nodes[second], noise))
        else:
            motion = nodes[first].between(nodes[second])
            graph.add(gtsam.BetweenFactorPose3(first, second, motion, noise))
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")  # of the square root: deviations may differ by 1e5
    solved = gtsam.ISAM2(parameters)
    solved.update(graph, values)
    back = np.ix_(TO_GTSAM, TO_GTSAM)
    return {node: solved.marginalCovariance(node)[back] for node in nodes}


class Agreement:
    """Tells which loops agree pairwise within the drift; loops are added as they are found."""

    def __init__(self) -> None:
        self.loops: list[Edge] = []
        self._agree = np.zeros((0, 0), bool)

    def add(self, loops: Sequence[Edge], T_map_node: NDArray[np.float64], drift: PathDrift) -> None:
        """Compare loops with all others; `T_map_node` (N, 4, 4) are the estimated nodes."""
        count, known = len(self.loops), [*self.loops, *loops]
        agree = np.zeros((len(known), len(known)), bool)
        agree[:count, :count] = self._agree
        for row in range(max(count, 1), len(known)):
            agree[row, :row] = _agree(known[row], known[:row], T_map_node, drift)
            agree[:row, row] = agree[row, :row]
        self.loops, self._agree = known, agree  # last: Ctrl-C may interrupt the comparison

    def cut(self, count: int) -> None:
        """Leave the loops between the first `count` nodes."""
        kept = [row for row, loop in enumerate(self.loops) if loop.second < count]
        self.loops, self._agree = [self.loops[row] for row in kept], self._agree[np.ix_(kept, kept)]

    def largest(self) -> list[int]:
        """Return the indices of the largest set of loops that agree pairwise."""
        return _largest_clique(self._agree)


def consistent(
    loops: Sequence[Edge], T_map_node: NDArray[np.float64], drift: PathDrift
) -> list[int]:
    """Return the indices of the largest set of loops that agree pairwise, as in `Agreement`."""
    agreement = Agreement()
    agreement.add(loops, T_map_node, drift)
    return agreement.largest()


def _agree(
    a: Edge, others: Sequence[Edge], T_map_node: NDArray[np.float64], drift: PathDrift
) -> NDArray[np.bool_]:
    """Tell of each other loop b whether the cycle of a, the path to b's end, b and back closes."""
    firsts, seconds = np.array([(b.first, b.second) for b in others]).T
    T_ends = se3.inverse(T_map_node[a.second]) @ T_map_node[seconds]
    T_starts = se3.inverse(T_map_node[a.first]) @ T_map_node[firsts]
    T_others = np.array([b.T_first_second for b in others])
    off = se3.log(se3.inverse(T_starts @ T_others) @ a.T_first_second @ T_ends)
    x_m, y_m, yaw_rad = drift.deviations(a.second, seconds, a.first, firsts).T
    lever_m = np.linalg.norm(T_ends[:, :3, 3], axis=1) + np.linalg.norm(T_starts[:, :3, 3], axis=1)
    tilt_rad = yaw_rad + _TILT_RAD
    path = np.stack([x_m, y_m, np.maximum(x_m, y_m), tilt_rad, tilt_rad, yaw_rad], axis=1)
    path[:, :3] += 0.5 * lever_m[:, None] * path[:, [5, 5, 4]]
    covariance = np.array([b.covariance for b in others])
    covariance += se3.carried(a.covariance, se3.inverse(T_ends))
    measured = np.diagonal(covariance, axis1=1, axis2=2)
    return np.asarray((off**2 / (path**2 + measured)).sum(axis=1) < _CHI2_6)


def _largest_clique(agree: NDArray[np.bool_]) -> list[int]:
    """Return the members of the largest clique that is grown greedily, the best connected first.

    It is grown from nodes that the largest so far does not hold, as most loops agree.
    """
    best: list[int] = []
    degrees, vain = agree.sum(axis=1), 0
    for start in np.argsort(-degrees, kind="stable").tolist():
        if degrees[start] + 1 <= len(best) or vain == _VAIN:
            break
        if start in best:
            continue
        members, others = [start], agree[start].copy()
        shared = agree[:, others].sum(axis=1)  # neighbours among the others
        while others.any():
            chosen = int(np.argmax(np.where(others, shared, -1)))
            members.append(chosen)
            gone = others & ~agree[chosen]
            others &= agree[chosen]
            shared -= agree[:, gone].sum(axis=1)
        vain += 1
        if len(members) > len(best):
            best, vain = members, 0
    return sorted(best)
