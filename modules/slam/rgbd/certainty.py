"""How exactly a pose is known beside the map around it, by more than its pixels' noise.

What a wrong model of the camera does to a pose (intrinsics, shutter, depth against colours) no
covariance of pixels knows, and without depth the map's scale drifts, which no image shows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.se3 import Transform

from .landmarks import LandmarkTable
from .localizer import Fix
from .pose_graph import motion_covariance
from .pose_solver import Linearised
from .view import View

_CELLS = 8  # across the image, within which residuals are summed up
_INDEPENDENT = 1.5  # common ratio up to which no wrong model shows: 1.0 to 1.7 in simulations,
# 2.1 to 3.8 on freiburg1_rpy, 1.3 to 2.6 on RedKitchen
_NOT_HELD = 1e-9  # of all information, added to every direction
_AROUND_M = 1.5  # five keyframes, as are adjusted at a time: beyond, wheels measured the scale anew
_KEPT = 0.95  # from image to image, of what residuals have in common


class Certainty:
    """Widens the covariance of a pose by what its residuals and landmarks say of the model."""

    def __init__(self, landmarks: LandmarkTable) -> None:
        self._landmarks = landmarks
        self._common: float | None = None  # see `common_ratio`, followed over images
        self._scaled_local = np.zeros(3)  # [m], where the camera was when its scale was known
        self.by_wheels = np.zeros((6, 6))  # the share of the last one that is also the wheels'

    def covariance(
        self, view: View, fix: Fix, T_local_base: Transform, T_keyframe_base: Sequence[Transform]
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a pose, of se3.log order [m, rad], in base.

        It is that of the pose beside the map around it. Residuals that neighbouring pixels have
        in common are no noise: where they say so, it holds the share of the motion from the
        keyframes around it that no noise explains, and as much less of the pixels' information.
        What triangulated landmarks do not know of the scale counts from where depth was seen last.
        """
        common = self._follow(common_ratio(view, fix))
        measured = fix.estimate.covariance * common
        motions = motion_covariance(np.stack(T_keyframe_base), np.zeros((6, 6)))
        model = motions.mean(axis=0) * np.clip(common - _INDEPENDENT, 0.0, 1.0)
        # A turn that is wrong is made up for by a shift, by as much as what is seen is far.
        away_m = self._landmarks.points_local[fix.landmark_ids] - T_local_base[:3, 3]
        model[:3, :3] += np.median((away_m**2).sum(axis=1)) * model[3:, 3:]
        scale = np.zeros((6, 6))
        scale[:3, :3] = self.scale_variance(view, fix, T_local_base)
        self.by_wheels = scale if view.reckoned is not None else 0.0 * scale
        return np.asarray(measured + model + scale)

    def _follow(self, ratio: float) -> float:
        before = ratio if self._common is None else self._common
        self._common = _KEPT * before + (1.0 - _KEPT) * ratio
        return max(1.0, self._common)

    def scale_variance(self, view: View, fix: Fix, T_local_base: Transform) -> NDArray[np.float64]:
        """Return (3, 3) [m^2]: the way since the scale was known, times how unsure it is."""
        sigmas = self._landmarks.scale_sigma[fix.landmark_ids]
        if not view.is_monocular or not sigmas.any():
            self._scaled_local = T_local_base[:3, 3].copy()
        way_local = T_local_base[:3, 3] - self._scaled_local
        length_m = float(np.linalg.norm(way_local))
        if view.reckoned is not None and length_m > _AROUND_M:
            way_local = way_local * (_AROUND_M / length_m)
        way_base = T_local_base[:3, :3].T @ way_local
        return np.asarray(np.mean(sigmas**2) * np.outer(way_base, way_base))


def common_ratio(view: View, fix: Fix) -> float:
    """Return how much more residuals pull at the pose than independent ones would.

    The pulls of all pixels of a cell, summed and squared, over the sum of squares: 1 where they
    are independent. As in a covariance that is robust against clusters (Liang and Zeger 1986).
    """
    seen: Linearised = fix.estimate.linearised
    pulls = (seen.jacobian * seen.residuals).reshape(6, 2, -1).sum(axis=1)  # (6, N)
    normal = seen.jacobian @ seen.jacobian.T
    # Pixels alone do not hold every pose: corners on a line, say, whose depths do.
    root = np.linalg.cholesky(normal + _NOT_HELD * np.trace(normal) * np.eye(6))
    pulls = np.linalg.solve(root, pulls)
    side_px = view.gray.shape[1] / _CELLS
    columns, rows = np.floor(view.features.uv_px[fix.feature_rows].T / side_px).astype(np.int64)
    columns -= columns.min()
    flat = (rows - rows.min()) * (columns.max() + 1) + columns
    sums = np.stack([np.bincount(flat, row) for row in pulls])
    return float((sums**2).sum() / max((pulls**2).sum(), 1e-12))
