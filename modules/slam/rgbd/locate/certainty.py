"""The covariance of a pose relative to the local map, including errors beyond pixel noise.

Pixel noise does not cover the errors of a wrong camera model (intrinsics, shutter, registration of
depth), nor, without depth, the drift of the map's scale, which no image shows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.se3 import Transform

from ...model_error import Smoothed, model_covariance, squared, summed
from ..map.landmarks import LandmarkTable
from ..see.view import View
from .localizer import VisualFix
from .pose_solver import Linearised

_CELLS = 8  # per image width, in which residuals are summed
_INDEPENDENT = 1.5  # common ratio of a correct model, mostly: 1.0 to 1.9 in simulations, 1.5 to
# 4.6 on freiburg1_rpy, 1.7 to 3.8 on RedKitchen (10 to 90 % of the images)
_AGREEING = 0.84  # mean square of normal residuals that agree: within their 95 % limit
_FINEST = 9e-4  # least of `noise_ratio`, for an image like the last; 0.006 is measured at rest
_AROUND_M = 1.5  # length of five keyframes, adjusted together; beyond, wheels give the scale


class Certainty:
    """Increases a pose's covariance by the model errors that residuals and landmarks show."""

    def __init__(self, landmarks: LandmarkTable) -> None:
        self._landmarks = landmarks
        self._common = Smoothed()  # `common_ratio`
        self._scaled_local = np.zeros(3)  # (3,) [m], the last position with known scale
        self.by_wheels = np.zeros((6, 6))  # share of the last covariance due to wheels

    def covariance(
        self,
        view: View,
        fix: VisualFix,
        T_local_base: Transform,
        T_keyframe_base: Sequence[Transform],
    ) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of a pose, of se3.log order [m, rad], in base.

        It is relative to the local map. The image's noise is as large as the pixels' residuals
        show, of depths, too; odometry's covariance remains as it is. If neighbouring pixels have
        common residuals, which are not noise, the image's information is reduced accordingly, and a
        share of the motion from the surrounding keyframes is added, by the variance that is in
        common. The scale error of triangulated landmarks grows from the place where depth was seen
        last.
        """
        common = max(1.0, self._common.follow(common_ratio(view, fix)))
        noise = float(np.clip(noise_ratio(fix), _FINEST, 1.0))
        prior = fix.estimate.prior
        by_image = np.linalg.inv(fix.estimate.covariance) - prior
        measured = np.linalg.inv(by_image / (common * noise) + prior)
        away_m = self._landmarks.points_local[fix.landmark_ids] - T_local_base[:3, 3]
        away2_m2 = float(np.median((away_m**2).sum(axis=1)))
        model = model_covariance(np.stack(T_keyframe_base), away2_m2)
        model *= np.clip(noise * (common - _INDEPENDENT), 0.0, 1.0)
        scale = np.zeros((6, 6))
        scale[:3, :3] = self.scale_variance(view, fix, T_local_base)
        self.by_wheels = scale if view.odometry is not None else 0.0 * scale
        return np.asarray(measured + model + scale)

    def scale_variance(
        self, view: View, fix: VisualFix, T_local_base: Transform
    ) -> NDArray[np.float64]:
        """Return (3, 3) [m^2]: variance by the scale's error over the motion since it was known."""
        sigmas = self._landmarks.scale_sigma[fix.landmark_ids]
        if not view.is_monocular or not sigmas.any():
            self._scaled_local = T_local_base[:3, 3].copy()
        way_local = T_local_base[:3, 3] - self._scaled_local
        length_m = float(np.linalg.norm(way_local))
        if view.odometry is not None and length_m > _AROUND_M:
            way_local = way_local * (_AROUND_M / length_m)
        way_base = T_local_base[:3, :3].T @ way_local
        return np.asarray(np.mean(sigmas**2) * np.outer(way_base, way_base))


def noise_ratio(fix: VisualFix) -> float:
    """Return the variance of the pixels that agree over that of their sigmas.

    It is the variance of unit weight, as in the adjustment of networks; pixels' sigmas are those of
    poor images: 0.2 in simulations, 0.5 to 0.6 on recordings.
    """
    return fix.estimate.linearised.pixel_variance / _AGREEING


def common_ratio(view: View, fix: VisualFix) -> float:
    """Return how much stronger the residuals' gradient is than that of independent residuals.

    The squared sum of the gradients of a cell's pixels over the sum of their squares: 1 if they are
    independent, as in a cluster-robust covariance (Liang and Zeger 1986).
    """
    seen: Linearised = fix.estimate.linearised
    pulls = (seen.jacobian * seen.residuals).reshape(6, 2, -1).sum(axis=1)  # (6, N)
    side_px = view.image_bgr.shape[1] / _CELLS
    columns, rows = np.floor(view.features.uv_px[fix.feature_rows].T / side_px).astype(np.int64)
    columns -= columns.min()
    blocks = (rows - rows.min()) * (columns.max() + 1) + columns
    normal = seen.jacobian @ seen.jacobian.T
    return squared(summed(pulls, blocks), normal) / max(squared(pulls, normal), 1e-12)
