"""Build the module's answers: tracked, started, or no pose measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.se3 import Transform

from .locate.localizer import VisualFix
from .map.segments import Segments
from .see.view import View

_START_VARIANCE = 1e-8  # the first pose is the origin by definition


def started(view: View, T_local_base: Transform, *, is_first: bool, revision: int) -> Tracking:
    """Return the answer when a keyframe was placed by the prediction, not by the map.

    The motion before the first usable image is known by odometry at best.
    """
    return Tracking(
        stamp_ns=view.observation.stamp_ns,
        T_local_base=T_local_base.copy(),
        status=TrackingStatus.TRACKING if is_first else TrackingStatus.DEGRADED,
        covariance=_START_VARIANCE * np.eye(6) if is_first else None,
        inliers=view.features.deep_count,
        revision=revision,
    )


def held(
    view: View,
    fix: VisualFix,
    T_local_base: Transform,
    *,
    status: TrackingStatus,
    covariance: NDArray[np.float64] | None,
    revision: int,
) -> Tracking:
    """Return the answer with T_local_base (4, 4) [m]; covariance (6, 6), None for odometry."""
    return Tracking(
        stamp_ns=view.observation.stamp_ns,
        T_local_base=T_local_base.copy(),
        status=status,
        covariance=covariance,
        quality_ratio=min(1.0, fix.found_ratio(view.features)),
        inliers=len(fix.landmark_ids),
        revision=revision,
    )


def placed(answer: Tracking, segments: Segments, segment: set[int]) -> Tracking:
    """Return an answer whose covariance includes that of its map segment's position."""
    measured = np.zeros((6, 6)) if answer.covariance is None else answer.covariance
    covariance = segments.covariance(segment, answer.T_local_base, measured)
    if covariance is None:
        return answer
    return replace(answer, status=TrackingStatus.DEGRADED, covariance=covariance)


def unseen(
    stamp_ns: int, T_local_base: Transform, status: TrackingStatus, *, revision: int
) -> Tracking:
    """Return the answer when an image measured no pose, with the pose that is known of.

    DEGRADED: the image repeats the last one. LOST: it is the last tracked pose.
    """
    return Tracking(
        stamp_ns=stamp_ns,
        T_local_base=T_local_base.copy(),
        status=status,
        quality_ratio=0.0,
        revision=revision,
    )
