"""Odometry constraints between keyframes without depth, from wheels and gyro.

Two images give a direction but no distance, and selecting landmarks with a certain distance favours
those estimated too near: without these constraints the scale shrinks from keyframe to keyframe.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from sceneslam.motion.predictor import Matrix, Prediction
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from ..locate.localizer import VisualFix
from ..map.keyframes import Keyframe, OdometryPose
from .pose_constraints import PoseConstraint

_SIGMA_M, _SIGMA_PER_M = 0.003, 0.02  # of the wheels' distance; a slip is an outlier
_SIGMA_RAD, _SIGMA_RAD_PER_M = 0.005, 0.01  # of the gyro's turn, and of the floor's tilt
_FARTHEST_M = 3.0  # largest distance between two keyframes: odometry over more adds nothing
_CORRELATED = 4.0  # images of the same landmarks err alike; 1 and 4 were tried in one hall
_CHI2 = 16.8  # 99 % of six degrees of freedom


class OdometryIntegrator:
    """Integrates wheels and gyro; never corrected by the map."""

    def __init__(self) -> None:
        self._now = OdometryPose(T_odom_base=se3.identity(), stretch=0)

    def add(self, prediction: Prediction) -> OdometryPose | None:
        """Return the pose by odometry alone; None without trusted odometry."""
        T_now = se3.orthonormal(self._now.T_odom_base @ prediction.motion.T_prev_curr)
        is_broken = not prediction.is_measured
        self._now = OdometryPose(T_odom_base=T_now, stretch=self._now.stretch + is_broken)
        return None if is_broken else self._now


def led(fix: VisualFix, prediction: Prediction, scale_variance: Matrix) -> VisualFix:
    """Return a pose that was found without depth, fused with odometry.

    `scale_variance` (3, 3) [m^2], in base, is the pose's variance by the map's scale error. If
    image and odometry contradict each other, the image's pose is returned, as wheels may slip.
    """
    found = fix.estimate
    measured = _CORRELATED * found.covariance
    measured[:3, :3] += scale_variance
    off = se3.log(se3.inverse(prediction.T_local_base) @ found.T_local_base)
    total = prediction.covariance + measured
    if off @ np.linalg.solve(total, off) > _CHI2:
        return fix
    gain = prediction.covariance @ np.linalg.inv(total)
    covariance = (np.eye(6) - gain) @ prediction.covariance
    estimate = replace(
        found,
        T_local_base=se3.orthonormal(prediction.T_local_base @ se3.exp(gain @ off)),
        covariance=0.5 * (covariance + covariance.T),
    )
    return replace(fix, estimate=estimate)


def odometry_constraints(
    keyframes: Mapping[int, Keyframe], T_base_cam: Transform
) -> dict[tuple[int, int], PoseConstraint]:
    """Return odometry's constraints between consecutive keyframes of which one has no depth."""
    constraints: dict[tuple[int, int], PoseConstraint] = {}
    for one, other in _neighbours(keyframes):
        here, there = keyframes[one].odometry, keyframes[other].odometry
        if here is None or there is None or here.stretch != there.stretch:
            continue
        T_one_other = se3.inverse(here.T_odom_base) @ there.T_odom_base
        distance_m = float(np.linalg.norm(T_one_other[:3, 3]))
        if distance_m > _FARTHEST_M:
            continue
        sigmas = np.repeat(
            [_SIGMA_M + _SIGMA_PER_M * distance_m, _SIGMA_RAD + _SIGMA_RAD_PER_M * distance_m], 3
        )
        constraints[one, other] = PoseConstraint(
            T_one_other=se3.inverse(T_base_cam) @ T_one_other @ T_base_cam,
            root=np.diag(1.0 / sigmas) @ se3.adjoint(T_base_cam),
        )
    return constraints


def _neighbours(keyframes: Mapping[int, Keyframe]) -> Iterable[tuple[int, int]]:
    """Yield pairs of consecutive keyframes of which the later one has no depth."""
    for one, other in pairwise(sorted(keyframes)):
        if keyframes[other].is_monocular:
            yield one, other
