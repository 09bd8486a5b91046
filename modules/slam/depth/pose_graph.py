"""Pose graph over keyframes: each is registered with all overlapping ones.

Frame-to-model tracking drifts; the graph corrects the drift when known places are revisited. Batch
Levenberg-Marquardt in gtsam is used, as there are few keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from ..surfaces.registration import CameraPrior, register, samples_of
from ..surfaces.surface import Doubles
from .keyframe_map import KeyframeMap

_MATCHED_MIN_RATIO = 0.5
_OVERLAP_MIN_RATIO = 0.25
_PARTNERS_MAX = 8
_HUBER_SIGMAS = 3.0
_LOOSE = 10.0  # information [1/m^2, 1/rad^2] of the edges by tracking
_GTSAM_ORDER = [3, 4, 5, 0, 1, 2]  # rotation first


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationEdge:
    """The measured pose of a keyframe relative to another."""

    first: int
    second: int
    T_first_second: Transform
    information: Doubles  # (6, 6) of se3.log order, second's cam


class DepthPoseGraph:
    """Registrations among keyframes, one per call, to bound the time per frame."""

    def __init__(self, keyframes: KeyframeMap, *, weak_ratio: float) -> None:
        self._map, self._weak_ratio = keyframes, weak_ratio
        self._edges: list[RegistrationEdge] = []
        self._waiting: list[tuple[int, int]] = []
        self.is_fresh = False  # there are new edges since the last optimisation

    def connect(self, index: int) -> None:
        """Queue registrations of a new keyframe with all overlapping ones."""
        if index:
            self._edges.append(self._chain(index))
        samples = samples_of(self._map[index].surface(), self._map.grid)
        overlaps = self._map.overlaps(samples, self._map[index].T_local_cam)
        partners = [o.index for o in overlaps if o.ratio > _OVERLAP_MIN_RATIO and o.index != index]
        self._waiting += [(partner, index) for partner in partners[:_PARTNERS_MAX]]

    def advance(self) -> bool:
        """Do one queued registration; return whether it was the last."""
        if not self._waiting:
            return False
        edge = self._register(*self._waiting.pop(0))
        if edge is not None:
            self._edges.append(edge)
            self.is_fresh = True
        return not self._waiting and self.is_fresh

    def finish(self) -> None:
        """Do all queued registrations, and optimise."""
        while self._waiting:
            self.advance()
        if self.is_fresh:
            self.solve()

    def solve(self) -> None:
        """Optimise the keyframes' poses; the first is fixed."""
        import gtsam

        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for index, keyframe in enumerate(self._map.keyframes):
            values.insert(index, gtsam.Pose3(keyframe.T_local_cam))
        fixed = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        graph.add(gtsam.PriorFactorPose3(0, values.atPose3(0), fixed))
        robust = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_SIGMAS)
        for edge in self._edges:
            ordered = edge.information[np.ix_(_GTSAM_ORDER, _GTSAM_ORDER)] + _LOOSE * np.eye(6)
            noise = gtsam.noiseModel.Gaussian.Information(ordered)
            graph.add(
                gtsam.BetweenFactorPose3(
                    edge.first,
                    edge.second,
                    gtsam.Pose3(edge.T_first_second),
                    gtsam.noiseModel.Robust.Create(robust, noise),
                )
            )
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        for index, keyframe in enumerate(self._map.keyframes):
            keyframe.move(np.array(solved.atPose3(index).matrix()))
        self.is_fresh = False

    def _chain(self, index: int) -> RegistrationEdge:
        """Return the weak edge by tracking, for directions without another constraint."""
        before, this = self._map[index - 1], self._map[index]
        return RegistrationEdge(
            index - 1, index, before.T_cam_local @ this.T_local_cam, np.zeros((6, 6))
        )

    def _register(self, first: int, second: int) -> RegistrationEdge | None:
        known, other = self._map[first], self._map[second]
        grid = self._map.grid
        guess = CameraPrior(other.T_local_cam, _LOOSE * np.eye(6))
        samples = samples_of(other.surface(), grid)
        found = register(samples, guess, [known], grid, weak_ratio=self._weak_ratio)
        if found is None or found.matched_ratio < _MATCHED_MIN_RATIO:
            return None
        T_first_second = se3.inverse(known.T_local_cam) @ found.T_local_cam
        return RegistrationEdge(first, second, T_first_second, found.information)
