"""Rules for a view: its tracking status, whether it becomes a keyframe, whether a map begins."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from statistics import median_low

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.predictor import Prediction
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.se3 import Transform

from ..map.keyframes import KeyframeStore
from ..see.view import View
from ..settings import RgbdSettings
from .localizer import VisualFix
from .pose_solver import PoseEstimate

_MIN_DEPTH_AGREEMENT_RATIO = 0.2  # with less, image and depth do not show the same place

_DEPTH_GAPS = 2  # between images with depth, after which none is expected
_DEPTH_GAP_MAX_NS = 1_000_000_000  # in more, the view leaves the map: from 1.4 s on it was lost
_SEARCHED_IMAGES = 3  # images searched in the map before a new segment begins

_RECENT = 20  # newest keyframes, which belong to the current path
_KNOWN_RATIO = 0.2  # of the step: the path was driven before


class HealthRule:
    """Calls a pose degraded if few landmarks support it, its position is uncertain in some
    direction, or the depth image contradicts it.
    """

    def __init__(self, settings: RgbdSettings) -> None:
        self._inliers, self._variance = settings.degraded_inliers, settings.degraded_sigma_m**2

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
        """Tell whether the position of a (6, 6) covariance is too uncertain in some direction."""
        return bool(np.linalg.eigvalsh(covariance[:3, :3])[-1] > self._variance)


class KeyframeRule:
    """Requests a keyframe if none is near, or if the image shows too few known landmarks."""

    def __init__(self, settings: RgbdSettings) -> None:
        self._per_m = 1.0 / settings.keyframe_step_m
        self._per_rad = 1.0 / settings.keyframe_turn_rad
        self._inlier_ratio = settings.keyframe_inlier_ratio
        self._most_inliers = 0
        self._deep_ns: int | None = None  # stamp of the last image with depth
        self._gaps_ns: deque[int] = deque(maxlen=3)  # between the last of these

    def restart(self) -> None:
        """Restart after a new keyframe."""
        self._most_inliers = 0

    def waits(self, view: View) -> bool:
        """Tell whether an image without depth leaves it to the next with depth to be a keyframe.

        Where depth comes at a lower rate than images, that is near, and knows how far landmarks
        are, also in a turn.
        """
        stamp_ns, before_ns = view.observation.stamp_ns, self._deep_ns
        if view.is_monocular:
            usual_ns = median_low(self._gaps_ns) if self._gaps_ns else 0
            is_usual = before_ns is not None and stamp_ns - before_ns < _DEPTH_GAPS * usual_ns
            return is_usual and usual_ns <= _DEPTH_GAP_MAX_NS
        if before_ns is not None:
            self._gaps_ns.append(stamp_ns - before_ns)
        self._deep_ns = stamp_ns
        return False

    def wants(
        self,
        T_local_base: Transform,
        fix: VisualFix,
        keyframes: KeyframeStore,
        segment: Collection[int] | None,
    ) -> bool:
        """Tell whether the view from T_local_base (4, 4) should become a keyframe of a segment."""
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
        """Tell whether T_local_base (4, 4) is more than a step from every keyframe."""
        return keyframes.nearest(T_local_base, per_m=self._per_m, per_rad=self._per_rad) > 1.0


class PlaceRule:
    """Decides whether a new map segment begins at a place that the map does not contain."""

    def __init__(self, settings: RgbdSettings) -> None:
        self._patience_s = settings.segment_patience_s
        self._images = 0  # images with enough features since the map was last seen

    def restart(self) -> None:
        """Restart after a tracked pose."""
        self._images = 0

    def wants(
        self, view: View, prediction: Prediction, *, unmeasured_s: float, is_far: bool
    ) -> bool:
        """Tell whether enough images were searched in the map for a new segment to begin.

        Without odometry the patience must have passed, too, as the pose is a guess. Without depth,
        odometry must have led far from all keyframes, so that landmarks have parallax.
        """
        self._images += view.shows_enough
        if self._images <= _SEARCHED_IMAGES:
            return False
        if prediction.is_measured:
            return is_far or not view.is_monocular
        return unmeasured_s >= self._patience_s and not view.is_monocular
