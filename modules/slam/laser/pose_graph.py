"""The pose graph: keyframes and measured motions between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.planar import Matrix, Planar

_HUBER = 1.345  # sigmas; 95 % efficiency relative to least squares, without outliers
_RELINEARIZE = 0.005  # m and rad: poses that moved less are not relinearized
_ROUNDS = 3  # relinearizations after a loop; more change the poses by millimetres
_ORIGIN_DEVIATION = 1e-4  # m and rad


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanEdge:
    """A measured motion between two keyframes."""

    first: int
    second: int
    T_first_second: Planar
    covariance: Matrix  # axes of second
    is_loop: bool


@dataclass(slots=True)
class ScanPoseGraph:
    """Smooths incrementally (iSAM2): the cost of a loop grows with the poses it changes."""

    edges: list[ScanEdge] = field(default_factory=list)
    _smoother: Any = field(default=None, init=False)
    _told: int = field(default=0, init=False)  # number of edges already in the smoother

    def add(self, edge: ScanEdge) -> None:
        """Add an edge; a new keyframe is added with the edge from the previous one."""
        self.edges.append(edge)

    def smooth(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the optimised poses (N, 3), from the current estimates `poses` (N, 3)."""
        import gtsam

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if self._smoother is None:
            self._smoother = gtsam.ISAM2(_parameters(gtsam))
            graph.add(_origin(gtsam, poses))
            values.insert(0, gtsam.Pose2(*poses[0]))
        for edge in self.edges[self._told :]:
            graph.add(_factor(gtsam, edge))
            if not edge.is_loop:
                values.insert(edge.second, gtsam.Pose2(*poses[edge.second]))
        self._told = len(self.edges)
        self._smoother.update(graph, values)
        for _ in range(_ROUNDS):
            self._smoother.update()
        return _poses(self._smoother.calculateEstimate(), len(poses))


def optimise(edges: list[ScanEdge], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the optimised poses (N, 3) (Levenberg-Marquardt), from the initial `poses`."""
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(_origin(gtsam, poses))
    for number, pose in enumerate(poses):
        values.insert(number, gtsam.Pose2(*pose))
    for edge in edges:
        graph.add(_factor(gtsam, edge))
    return _poses(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize(), len(poses))


def _parameters(gtsam: Any) -> Any:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(_RELINEARIZE)
    parameters.relinearizeSkip = 1
    return parameters


def _origin(gtsam: Any, poses: NDArray[np.float64]) -> Any:
    noise = gtsam.noiseModel.Isotropic.Sigma(3, _ORIGIN_DEVIATION)
    return gtsam.PriorFactorPose2(0, gtsam.Pose2(*poses[0]), noise)


def _factor(gtsam: Any, edge: ScanEdge) -> Any:
    noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
    if edge.is_loop:
        huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
        noise = gtsam.noiseModel.Robust.Create(huber, noise)
    return gtsam.BetweenFactorPose2(
        edge.first, edge.second, gtsam.Pose2(*edge.T_first_second), noise
    )


def _poses(values: Any, count: int) -> NDArray[np.float64]:
    found = [values.atPose2(number) for number in range(count)]
    return np.array([[pose.x(), pose.y(), pose.theta()] for pose in found])
