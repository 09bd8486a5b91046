"""Odometry constraints between keyframes, from wheels and gyro.

Without depth two images give a direction but no distance. A gyro measures turns better than images
whose corners all err alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.predictor import Prediction
from sceneslam.types import se3
from sceneslam.types.covariance import UNKNOWN_VELOCITY
from sceneslam.types.se3 import Transform

from ..locate.localizer import VisualFix
from ..locate.pose_solver import Prior
from ..map.keyframes import Keyframe, OdometryPose, motion_between
from .pose_constraints import PoseConstraint

_CLOCKS_S = 0.05  # between a camera's and a gyro's stamps
_SLIP = 3.0  # [sigma] of the distance; beyond, wheels probably slip
_CORRELATED = 4.0  # images of the same landmarks err alike; 1 and 4 were tried in one hall
_EXPLAINED_RATIO = 0.8  # of the landmarks; 0.9 to 1.05 where a far wall had turned the camera
_CHI2 = 16.8  # 99 % of six degrees of freedom


class OdometryIntegrator:
    """Integrates wheels and gyro; never corrected by the map."""

    def __init__(self) -> None:
        self._now = OdometryPose(T_odom_base=se3.identity(), stretch=0, variance=np.zeros(2))

    def add(self, prediction: Prediction) -> OdometryPose | None:
        """Return the pose by odometry alone; None without trusted odometry."""
        motion, before = prediction.motion, self._now
        is_broken = not prediction.is_measured
        self._now = OdometryPose(
            T_odom_base=se3.orthonormal(before.T_odom_base @ motion.T_prev_curr),
            stretch=before.stretch + is_broken,
            variance=before.variance + motion.covariance.diagonal()[[0, 3]],
        )
        return None if is_broken else self._now


def led(
    found: VisualFix,
    prediction: Prediction,
    together: Callable[[Prior], VisualFix | None],
    *,
    turn_radps: float | None,
    duration_s: float,
) -> VisualFix | None:
    """Return a pose that an image shows, fused with odometry; None if that contradicts the gyro.

    `turn_radps` is the turn rate by the gyro, None without one; `duration_s` is the time since the
    last pose. If a pose contradicts odometry, wheels may have slipped: then the image is solved
    `together` with what is left of it, as landmarks far away look about the same after a turn and
    a shift. Where that explains less of the image, the pose is fused with what is left. Last, the
    clocks of camera and gyro may differ.
    """
    slip_m, unknown_rad = UNKNOWN_VELOCITY * duration_s
    late_rad = unknown_rad if turn_radps is None else _CLOCKS_S * turn_radps
    slipping = _spread(prediction, slip_m, 0.0)
    return (
        _fused(found, prediction)
        or _held(found, slipping, together)
        or _fused(found, slipping)
        or _fused(found, _spread(prediction, slip_m, late_rad))
    )


def _spread(prediction: Prediction, off_m: float, off_rad: float) -> Prediction:
    """Return a prediction with larger deviations."""
    more = np.diag(np.repeat([off_m, off_rad], 3) ** 2)
    return replace(prediction, covariance=prediction.covariance + more)


def _fused(found: VisualFix, prediction: Prediction) -> VisualFix | None:
    """Return the mean of a pose and a prediction by their covariances; None: they contradict."""
    estimate, predicted = found.estimate, prediction.covariance
    off = se3.log(se3.inverse(prediction.T_local_base) @ estimate.T_local_base)
    total = predicted + _CORRELATED * estimate.covariance
    if off @ np.linalg.solve(total, off) > _CHI2:
        return None
    gain = predicted @ np.linalg.inv(total)
    T_local_base = se3.orthonormal(prediction.T_local_base @ se3.exp(gain @ off))
    covariance = (np.eye(6) - gain) @ predicted
    return _with(found, T_local_base, covariance, np.asarray(np.linalg.inv(predicted)))


def _held(
    alone: VisualFix, prediction: Prediction, together: Callable[[Prior], VisualFix | None]
) -> VisualFix | None:
    """Return the pose by image and prediction together; None if it is far from either.

    What the image shows `alone` has to be explained by it, too: near landmarks tell a slip.
    """
    information = np.asarray(np.linalg.inv(prediction.covariance))
    # The image's covariance is _CORRELATED times what its pixels say: the solver takes pixels as
    # they are, and so the prior as that much surer; what comes out is scaled back.
    prior = Prior(T_local_base=prediction.T_local_base, information=_CORRELATED * information)
    found = together(prior)
    if found is None or len(found.landmark_ids) < _EXPLAINED_RATIO * len(alone.landmark_ids):
        return None
    off = prior.off(found.estimate.T_local_base)
    if off @ information @ off > _CHI2:
        return None
    covariance = _CORRELATED * found.estimate.covariance
    return _with(found, found.estimate.T_local_base, covariance, information)


def _with(
    found: VisualFix,
    T_local_base: Transform,
    covariance: NDArray[np.float64],
    prior: NDArray[np.float64],
) -> VisualFix:
    covariance = 0.5 * (covariance + covariance.T)
    estimate = replace(
        found.estimate, T_local_base=T_local_base, covariance=covariance, prior=prior
    )
    return replace(found, estimate=estimate)


def odometry_constraints(
    keyframes: Mapping[int, Keyframe], T_base_cam: Transform
) -> list[tuple[tuple[int, int], PoseConstraint]]:
    """Return odometry's constraints between consecutive keyframes.

    Distance and turn are constrained apart, as wheels that slip still have a gyro. A distance that
    the keyframes contradict weighs next to nothing (Geman and McClure).
    """
    to_base = se3.adjoint(T_base_cam)
    found = []
    for one, other in pairwise(sorted(keyframes)):
        motion = motion_between(keyframes[one], keyframes[other])
        if motion is None:
            continue
        T_one_other = se3.inverse(T_base_cam) @ motion.T_here_there @ T_base_cam
        seen = se3.inverse(keyframes[one].T_local_base) @ keyframes[other].T_local_base
        of_m, of_rad = motion.variance
        off_m2 = float(((seen[:3, 3] - motion.T_here_there[:3, 3]) ** 2).sum())
        per_m = of_m**-0.5 * _SLIP**2 / (_SLIP**2 + off_m2 / of_m)
        # Corners err alike, so that their information is too large by comparison.
        per_rad = (of_rad / _CORRELATED) ** -0.5
        for weights in ([per_m] * 3 + [0.0] * 3, [0.0] * 3 + [per_rad] * 3):
            root = np.diag(weights) @ to_base
            found.append(((one, other), PoseConstraint(T_one_other=T_one_other, root=root)))
    return found
