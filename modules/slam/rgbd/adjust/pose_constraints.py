"""Relative-pose constraints between keyframes by registration of their depth images.

Corners constrain a pose well if they are near and their depth is right; surfaces constrain it by
all pixels, independent of the colours' calibration. Both together err less than either.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from ...surfaces.keyframe import SurfaceKeyframe
from ...surfaces.registration import CameraPrior, Samples, register, samples_of
from ...surfaces.surface import DepthSurfaceReader

_MIN_MATCHED_RATIO = 0.5  # of the common area, on the same surface
_WEAK_RATIO = 0.005  # localizability below which surfaces do not constrain a direction
_PRIOR_INFORMATION = 1.0  # [1/m^2] and [1/rad^2]: negligible
_KEPT = 60  # views, of 0.6 MB each
_TRUST = 3.0  # weight of a registration's information relative to that of corners
_HUBER = 3.5  # [sigma], 95 % of six degrees of freedom


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseConstraint:
    """A measured T_one_other of two cameras."""

    T_one_other: Transform
    root: NDArray[np.float64]  # (6, 6), of the information of a twist of the other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseConstraints:
    """The relative-pose constraints of a bundle, by rows of its keyframes."""

    one: NDArray[np.int64]  # (M,)
    other: NDArray[np.int64]  # (M,)
    T_other_one: NDArray[np.float64]  # (M, 4, 4)
    roots: NDArray[np.float64]  # (M, 6, 6), see PoseConstraint

    @staticmethod
    def of(constraints: Sequence[tuple[tuple[int, int], PoseConstraint]]) -> PoseConstraints:
        """Return the constraints, each given with the rows of its two keyframes."""
        rows = np.array([pair for pair, _ in constraints], np.int64).reshape(-1, 2)
        measured = [constraint for _, constraint in constraints]
        T_one_other = np.array([each.T_one_other for each in measured]).reshape(-1, 4, 4)
        roots = np.array([each.root for each in measured]).reshape(-1, 6, 6)
        one, other = rows.T
        return PoseConstraints(
            one=one, other=other, T_other_one=se3.inverse(T_one_other), roots=roots
        )

    def residuals_at(self, T_local_cam: NDArray[np.float64]) -> ConstraintResiduals:
        """Return the constraints' residuals at these poses (K, 4, 4)."""
        T_one_other = se3.inverse(T_local_cam[self.one]) @ T_local_cam[self.other]
        off = se3.log(self.T_other_one @ T_one_other)
        return ConstraintResiduals(
            constraints=self,
            T_one_other=T_one_other,
            residuals=(self.roots @ off[:, :, None])[:, :, 0],
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConstraintResiduals:
    """Residuals and weights of the constraints at the keyframes' poses."""

    constraints: PoseConstraints
    T_one_other: NDArray[np.float64]  # (M, 4, 4)
    residuals: NDArray[np.float64]  # (M, 6) in sigmas

    @property
    def weights(self) -> NDArray[np.float64]:
        """Return Huber's weights (M,)."""
        return np.asarray(_HUBER / np.maximum(_HUBER, np.linalg.norm(self.residuals, axis=1)))

    @property
    def cost(self) -> float:
        """Return Huber's cost."""
        squares, weights = (self.residuals**2).sum(axis=1), self.weights
        return float((squares * weights * (2.0 - weights)).sum())

    def add_to(
        self,
        blocks: NDArray[np.float64],
        slopes: NDArray[np.float64],
        is_free: NDArray[np.bool_],
    ) -> None:
        """Add the normal equations of the free keyframes to blocks (F, F, 6, 6), slopes (F, 6)."""
        free = np.cumsum(is_free) - 1
        by_one = -self.constraints.roots @ se3.adjoint(se3.inverse(self.T_one_other))
        ends = [(self.constraints.one, by_one), (self.constraints.other, self.constraints.roots)]
        weights = self.weights[:, None, None]
        for rows, by in ends:
            pulled = weights * np.swapaxes(by, 1, 2)
            held = is_free[rows]
            slope = (pulled @ self.residuals[:, :, None])[held, :, 0]
            np.add.at(slopes, free[rows[held]], slope)
            for columns, by_column in ends:
                both = held & is_free[columns]
                cell = free[rows[both]], free[columns[both]]
                np.add.at(blocks, cell, (pulled @ by_column)[both])


class DepthConstraints:
    """Registers keyframes' depth images with each other; for use in one thread."""

    def __init__(self, depth_camera: Camera, T_depth_cam: Transform) -> None:
        self._reader, self._T_depth_cam = DepthSurfaceReader(depth_camera), T_depth_cam
        self._views: dict[int, SurfaceKeyframe] = {}
        self._samples: dict[int, Samples] = {}

    @property
    def known_ids(self) -> Set[int]:
        """Return the keyframes that can still be registered."""
        return self._views.keys()

    def look(self, keyframe_id: int, depth_m: NDArray[np.float32]) -> None:
        """Add a keyframe's depth image (H, W) [m]."""
        surface = self._reader.read(depth_m)
        self._views[keyframe_id] = SurfaceKeyframe(surface, se3.identity())
        self._samples[keyframe_id] = samples_of(surface, self._reader.grid)
        for oldest in list(self._views)[:-_KEPT]:
            del self._views[oldest], self._samples[oldest]

    def between(self, one: int, other: int, T_one_other: Transform) -> PoseConstraint | None:
        """Return the constraint between two keyframes by their surfaces, None if these disagree.

        `T_one_other` (4, 4) is the initial relative pose.
        """
        if one not in self._views or other not in self._views:
            return None
        to_cam = se3.inverse(self._T_depth_cam)
        prior = CameraPrior(
            self._T_depth_cam @ T_one_other @ to_cam, _PRIOR_INFORMATION * np.eye(6)
        )
        found = register(
            self._samples[other],
            prior,
            [self._views[one]],
            self._reader.grid,
            weak_ratio=_WEAK_RATIO,
        )
        if found is None or found.matched_ratio < _MIN_MATCHED_RATIO:
            return None
        squares, axes = np.linalg.eigh(_TRUST * found.information)
        root = np.sqrt(np.maximum(squares, 0.0))[:, None] * axes.T
        return PoseConstraint(
            T_one_other=to_cam @ found.T_local_cam @ self._T_depth_cam,
            root=root @ se3.adjoint(self._T_depth_cam),
        )
