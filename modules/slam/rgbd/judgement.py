"""Two decisions about a pose that was found: how far to trust it, and whether to keep the view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import TrackingStatus
from sceneslam.types.se3 import Transform

from .keyframes import KeyframeStore
from .localizer import Fix


class HealthRule:
    """Calls a pose degraded that few landmarks hold, or that some direction is unsure of."""

    def __init__(self, *, degraded_inliers: int, degraded_sigma_m: float) -> None:
        self._inliers, self._variance = degraded_inliers, degraded_sigma_m**2

    def judge(self, inliers: int, covariance: NDArray[np.float64]) -> TrackingStatus:
        """Return TRACKING or DEGRADED."""
        worst_variance = float(np.linalg.eigvalsh(covariance[:3, :3])[-1])
        if inliers < self._inliers or worst_variance > self._variance:
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
            return True
        return keyframes.nearest(T_local_base, per_m=self._per_m, per_rad=self._per_rad) > 1.0
