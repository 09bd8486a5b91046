"""Two decisions about a pose that was found: how far to trust it, and whether to keep the view."""

from __future__ import annotations

import numpy as np

from sceneslam.types.observation import TrackingStatus
from sceneslam.types.se3 import Transform

from .keyframes import KeyframeStore
from .localizer import Fix
from .pose_solver import PoseEstimate

_MIN_DEPTH_AGREEMENT_RATIO = 0.2  # below, image and depth do not show the same place

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
        worst_variance = float(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1])
        if (
            int(estimate.inliers.sum()) < self._inliers
            or worst_variance > self._variance
            or estimate.depth_agreement_ratio < _MIN_DEPTH_AGREEMENT_RATIO
        ):
            return TrackingStatus.DEGRADED
        return TrackingStatus.TRACKING


class KeyframeRule:
    """Asks for a keyframe where none is near, or where the map is running out of the image."""

    def __init__(self, *, step_m: float, turn_rad: float, inlier_ratio: float) -> None:
        self._per_m, self._per_rad = 1.0 / step_m, 1.0 / turn_rad
        self._inlier_ratio = inlier_ratio
        self._most_inliers = 0

    def restart(self) -> None:
        """Hear that a keyframe was made."""
        self._most_inliers = 0

    def wants(self, T_local_base: Transform, fix: Fix, keyframes: KeyframeStore) -> bool:
        """Tell whether the view from T_local_base should become a keyframe."""
        count = len(fix.landmark_ids)
        self._most_inliers = max(self._most_inliers, count)
        if count < self._inlier_ratio * self._most_inliers:
            return self._steps_away(T_local_base, keyframes, but_latest=_RECENT) > _KNOWN_RATIO
        return self.is_far(T_local_base, keyframes)

    def is_far(self, T_local_base: Transform, keyframes: KeyframeStore) -> bool:
        """Tell whether T_local_base is more than a step from every keyframe."""
        return self._steps_away(T_local_base, keyframes, but_latest=0) > 1.0

    def _steps_away(
        self, T_local_base: Transform, keyframes: KeyframeStore, *, but_latest: int
    ) -> float:
        return keyframes.nearest(
            T_local_base, per_m=self._per_m, per_rad=self._per_rad, but_latest=but_latest
        )
