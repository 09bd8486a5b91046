"""Edges in gtsam, and the poses that fit them best."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.graphs.edge import Edge
from sceneslam.types.se3 import Transform

TO_GTSAM = [3, 4, 5, 0, 1, 2]  # rotation first, and back
_HELD_SIGMA = 1e-6  # [m] and [rad] of the fixed pose


def noise_of(covariance: NDArray[np.float64]) -> Any:
    """Return a covariance (6, 6) of se3.log order as a noise model."""
    import gtsam

    return gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_(TO_GTSAM, TO_GTSAM)])


def factor_of(edge: Edge, huber_sigmas: float | None = None) -> Any:
    """Return an edge as a factor; beyond `huber_sigmas`, if given, it weighs less (Huber)."""
    import gtsam

    noise = noise_of(edge.covariance)
    if huber_sigmas is not None:
        huber = gtsam.noiseModel.mEstimator.Huber.Create(huber_sigmas)
        noise = gtsam.noiseModel.Robust.Create(huber, noise)
    T_first_second = gtsam.Pose3(edge.T_first_second)
    return gtsam.BetweenFactorPose3(edge.first, edge.second, T_first_second, noise)


def fit(
    T: Mapping[int, Transform], edges: Iterable[Edge], *, held: int, huber_sigmas: float
) -> dict[int, Transform]:
    """Return the poses (4, 4) that best fit the edges (Levenberg-Marquardt, Huber on loops).

    `held` is the node of the fixed pose. Loops off by more than `huber_sigmas` weigh less.
    """
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for node, pose in T.items():
        values.insert(node, gtsam.Pose3(pose))
    for edge in edges:
        graph.add(factor_of(edge, huber_sigmas if edge.is_loop else None))
    stays = gtsam.noiseModel.Isotropic.Sigma(6, _HELD_SIGMA)
    graph.add(gtsam.PriorFactorPose3(held, gtsam.Pose3(T[held]), stays))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return {node: found.atPose3(node).matrix() for node in T}
