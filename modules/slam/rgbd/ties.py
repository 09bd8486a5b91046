"""Ties between keyframes: relative poses that two whole depth images agree on.

Corners hold a pose well where they are near and their depth is right; surfaces hold it by all
pixels, whatever the colours' calibration. Both together err less than either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from ..depth.keyframe import Keyframe as DepthKeyframe
from ..depth.registration import Prior, Samples, register, samples_of
from ..depth.surface import SurfaceReader

_MIN_MATCHED_RATIO = 0.5  # of what both images show, on the same surface
_WEAK_RATIO = 0.005  # localizability below which surfaces do not hold a direction
_PRIOR_INFORMATION = 1.0  # [1/m^2] and [1/rad^2]: next to nothing
_KEPT = 60  # views, of 0.6 MB each
_TRUST = 3.0  # of a registration's information, beside that of corners
_HUBER = 3.5  # [sigma], 95 % of six degrees of freedom


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tie:
    """A measured T_one_other of two cameras."""

    T_one_other: Transform
    root: NDArray[np.float64]  # (6, 6), of the information of a twist of the other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pull:
    """A tie between two keyframes of a bundle, by their rows, at the poses they have."""

    one: int
    other: int
    residual: NDArray[np.float64]  # (6,) in sigmas
    by_one: NDArray[np.float64]  # (6, 6)
    by_other: NDArray[np.float64]  # (6, 6)

    @property
    def weight(self) -> float:
        """Return Huber's weight."""
        return _HUBER / max(_HUBER, float(np.linalg.norm(self.residual)))

    @property
    def cost(self) -> float:
        """Return Huber's cost."""
        return float(self.residual @ self.residual) * self.weight * (2.0 - self.weight)


def pull(tie: Tie, T_local_cam: NDArray[np.float64], one: int, other: int) -> Pull:
    """Return how a tie pulls at two of the poses (K, 4, 4)."""
    T_one_other = se3.inverse(T_local_cam[one]) @ T_local_cam[other]
    off = se3.log(se3.inverse(tie.T_one_other) @ T_one_other)
    return Pull(
        one=one,
        other=other,
        residual=tie.root @ off,
        by_one=-tie.root @ se3.adjoint(se3.inverse(T_one_other)),
        by_other=tie.root,
    )


class DepthTies:
    """Registers keyframes' depth images with each other; works in one thread."""

    def __init__(self, depth_camera: Camera, T_depth_cam: Transform) -> None:
        self._reader, self._T_depth_cam = SurfaceReader(depth_camera), T_depth_cam
        self._views: dict[int, DepthKeyframe] = {}
        self._samples: dict[int, Samples] = {}

    def look(self, keyframe_id: int, depth_m: NDArray[np.float32]) -> None:
        """Take a keyframe's depth image."""
        surface = self._reader.read(depth_m)
        self._views[keyframe_id] = DepthKeyframe(surface, se3.identity(), stamp_ns=0)
        self._samples[keyframe_id] = samples_of(surface, self._reader.grid)
        for oldest in list(self._views)[:-_KEPT]:
            del self._views[oldest], self._samples[oldest]

    def tie(self, one: int, other: int, T_one_other: Transform) -> Tie | None:
        """Return where two keyframes are by their surfaces, None where these do not agree.

        `T_one_other` is about where they are.
        """
        if one not in self._views or other not in self._views:
            return None
        to_cam = se3.inverse(self._T_depth_cam)
        prior = Prior(self._T_depth_cam @ T_one_other @ to_cam, _PRIOR_INFORMATION * np.eye(6))
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
        return Tie(
            T_one_other=to_cam @ found.T_local_cam @ self._T_depth_cam,
            root=root @ se3.adjoint(self._T_depth_cam),
        )
