"""What the module tells of an observation: where it held a pose, began one, or has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.se3 import Transform

from .localizer import Fix
from .segments import Segments
from .view import View

_START_VARIANCE = 1e-8  # the first pose is the origin by definition


def started(view: View, T_local_base: Transform, *, is_first: bool, revision: int) -> Tracking:
    """Return the answer where a keyframe was hung on a prediction, not on the map.

    What the robot did before the first usable image is known from odometry at best.
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
    fix: Fix,
    T_local_base: Transform,
    *,
    status: TrackingStatus,
    covariance: NDArray[np.float64] | None,
    revision: int,
) -> Tracking:
    """Return the answer where the map was seen; a reckoned pose has no covariance."""
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
    """Return an answer with what is not known of where its segment of the map lies."""
    measured = np.zeros((6, 6)) if answer.covariance is None else answer.covariance
    covariance = segments.covariance(segment, answer.T_local_base, measured)
    if covariance is None:
        return answer
    return replace(answer, status=TrackingStatus.DEGRADED, covariance=covariance)


def repeated(stamp_ns: int, T_local_base: Transform, *, revision: int) -> Tracking:
    """Return the answer where no new image came: odometry's pose, else the last, for it may stand.

    Nobody knows how exact it is.
    """
    return Tracking(
        stamp_ns=stamp_ns,
        T_local_base=T_local_base.copy(),
        status=TrackingStatus.DEGRADED,
        quality_ratio=0.0,
        revision=revision,
    )


def lost(stamp_ns: int, T_local_base: Transform, *, revision: int) -> Tracking:
    """Return the answer where no pose can be told: the last one that was held."""
    return Tracking(
        stamp_ns=stamp_ns,
        T_local_base=T_local_base.copy(),
        status=TrackingStatus.LOST,
        quality_ratio=0.0,
        revision=revision,
    )
