"""Pose graph over keyframes: each is registered with all overlapping ones.

Frame-to-model tracking drifts; the graph corrects the drift when known places are revisited. Batch
Levenberg-Marquardt in gtsam is used, as there are few keyframes.
"""

from __future__ import annotations

import numpy as np

from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.graphs.factors import fit
from sceneslam.types import se3

from ..surfaces.registration import CameraPrior, register, samples_of
from ..surfaces.surface import Doubles
from .keyframe_map import KeyframeMap

_MATCHED_MIN_RATIO = 0.5
_OVERLAP_MIN_RATIO = 0.25
_PARTNERS_MAX = 8
_HUBER_SIGMAS = 3.0
_LOOSE = 10.0  # information [1/m^2, 1/rad^2] of where a registration begins, and of its edge
_TRACKED = 0.01**2 * np.eye(6)  # m^2, rad^2: by which tracking errs beyond what it says


class DepthPoseGraph:
    """Registrations among keyframes, one per call, to bound the time per frame."""

    def __init__(self, keyframes: KeyframeMap, *, weak_ratio: float) -> None:
        self._map, self._weak_ratio = keyframes, weak_ratio
        self._edges: list[Edge] = []
        self._waiting: list[tuple[int, int]] = []
        self.is_fresh = False  # there are new edges since the last optimisation

    def connect(self, index: int, covariance: Doubles, *, tracked_by: int) -> None:
        """Queue registrations of a new keyframe with all overlapping ones.

        `covariance` (6, 6) is that of its pose as tracked by another keyframe, `tracked_by`, cam:
        large where it was guessed. The first keyframe has no other.
        """
        if index:
            self._edges.append(self._tracked(tracked_by, index, covariance))
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
        poses = {index: one.T_local_cam for index, one in enumerate(self._map.keyframes)}
        solved = fit(poses, self._edges, held=0, huber_sigmas=_HUBER_SIGMAS)
        for index, keyframe in enumerate(self._map.keyframes):
            keyframe.move(solved[index])
        self.is_fresh = False

    def _tracked(self, first: int, second: int, covariance: Doubles) -> Edge:
        """Return the edge by tracking, which knows what odometry measured, too."""
        return Edge(
            first=first,
            second=second,
            T_first_second=self._map[first].T_cam_local @ self._map[second].T_local_cam,
            covariance=_TRACKED + covariance,
        )

    def _register(self, first: int, second: int) -> Edge | None:
        known, other = self._map[first], self._map[second]
        grid = self._map.grid
        guess = CameraPrior(other.T_local_cam, _LOOSE * np.eye(6))
        samples = samples_of(other.surface(), grid)
        found = register(samples, guess, [known], grid, weak_ratio=self._weak_ratio)
        if found is None or found.matched_ratio < _MATCHED_MIN_RATIO:
            return None
        T_first_second = se3.inverse(known.T_local_cam) @ found.T_local_cam
        return Edge(
            first=first,
            second=second,
            T_first_second=T_first_second,
            covariance=np.asarray(np.linalg.inv(found.information + _LOOSE * np.eye(6))),
            kind=EdgeKind.LOOP,
        )
