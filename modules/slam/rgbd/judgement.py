"""Decisions on a view: how far to trust its pose, whether to keep it, whether to begin with it."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.predictor import Prediction
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.se3 import Transform

from .keyframes import KeyframeStore
from .localizer import Fix
from .pose_solver import PoseEstimate
from .view import View

_MIN_DEPTH_AGREEMENT_RATIO = 0.2  # below, image and depth do not show the same place

_SEARCHED_IMAGES = 3  # looked for in the map before a place is begun

_RECENT = 20  # keyframes that belong to the way here
_KNOWN_RATIO = 0.2  # of the step: a way taken before, of which there is nothing more to keep


class HealthRule:
    """Calls a pose degraded that few landmarks hold, or that some direction is unsure of,
    or that the depth image contradicts.
    """

    def __init__(self, *, degraded_inliers: int, degraded_sigma_m: float) -> None:
        self._inliers, self._variance = degraded_inliers, degraded_sigma_m**2

    def judge(self, estimate: PoseEstimate) -> TrackingStatus:
        """Return TRACKING or DEGRADED."""
        if (
            int(estimate.inliers.sum()) < self._inliers
            or self.is_unsure(estimate.covariance)
            or estimate.depth_agreement_ratio < _MIN_DEPTH_AGREEMENT_RATIO
        ):
            return TrackingStatus.DEGRADED
        return TrackingStatus.TRACKING

    def is_unsure(self, covariance: NDArray[np.float64]) -> bool:
        """Tell whether a position is not known well enough in some direction."""
        return bool(np.linalg.eigvalsh(covariance[:3, :3])[-1] > self._variance)


class KeyframeRule:
    """Asks for a keyframe where none is near, or where the map is running out of the image."""

    def __init__(self, *, step_m: float, turn_rad: float, inlier_ratio: float) -> None:
        self._per_m, self._per_rad = 1.0 / step_m, 1.0 / turn_rad
        self._inlier_ratio = inlier_ratio
        self._most_inliers = 0

    def restart(self) -> None:
        """Hear that a keyframe was made."""
        self._most_inliers = 0

    def wants(
        self,
        T_local_base: Transform,
        fix: Fix,
        keyframes: KeyframeStore,
        segment: Collection[int] | None,
    ) -> bool:
        """Tell whether the view from T_local_base should become a keyframe of a segment."""
        count = len(fix.landmark_ids)
        self._most_inliers = max(self._most_inliers, count)
        is_running_out = count < self._inlier_ratio * self._most_inliers
        distance = keyframes.nearest(
            T_local_base,
            per_m=self._per_m,
            per_rad=self._per_rad,
            but_latest=_RECENT if is_running_out else 0,
            among=segment,
        )
        return distance > (_KNOWN_RATIO if is_running_out else 1.0)

    def is_far(self, T_local_base: Transform, keyframes: KeyframeStore) -> bool:
        """Tell whether T_local_base is more than a step from every keyframe."""
        return keyframes.nearest(T_local_base, per_m=self._per_m, per_rad=self._per_rad) > 1.0


class PlaceRule:
    """Decides whether a place that the map does not show is begun anew."""

    def __init__(self, *, patience_s: float) -> None:
        self._patience_s = patience_s
        self._images = 0  # that showed enough, since the map was last seen

    def restart(self) -> None:
        """Hear that there is a pose."""
        self._images = 0

    def wants(
        self, view: View, prediction: Prediction, *, unmeasured_s: float, is_far: bool
    ) -> bool:
        """Tell whether the place was often enough looked for in the map.

        Where odometry led there, and else once the patience is over, for that is a guess. Without
        depth, odometry has to have led far from all keyframes, to see anything in two.
        """
        self._images += view.shows_enough
        if self._images <= _SEARCHED_IMAGES:
            return False
        if prediction.is_measured:
            return is_far or not view.is_monocular
        return unmeasured_s >= self._patience_s and not view.is_monocular
