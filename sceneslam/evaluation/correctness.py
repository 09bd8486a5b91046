"""Correct Rate: the share of time with a correct pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import covered, interpolated, select
from sceneslam.evaluation.path import driven_m
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import TRUTH_GAP_S

_POSE_GAP_NS = 10**9  # longest time that one pose counts


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Judged:
    """The poses within the ground truth's time span, ordered by stamp."""

    stamps_ns: NDArray[np.int64]  # (N,)
    is_correct: NDArray[np.bool_]  # (N,)


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectLimits:
    """The error limits of a correct pose."""

    limit_m: float
    limit_rad: float
    limit_ratio: float = 0.0  # of the distance driven so far, added to `limit_m`


def correct_rate(estimate: Trajectory, truth: Trajectory, limits: CorrectLimits) -> float:
    """Return the share of the truth's time span with a correct pose, in [0, 1].

    The definition of OpenLORIS-Scene (Shi et al., ICRA 2020): the estimate is aligned as a whole
    (SE(3), least squares, ground truth interpolated to its stamps); a pose is correct within both
    limits and then counts for the time to the next pose, at most 1 s. Unlike the mean error, it
    cannot be improved by omitting poses. NaN without ground truth.
    """
    if len(truth) < 2 or truth.stamps_ns[0] == truth.stamps_ns[-1]:
        return float("nan")
    judged = _judge(estimate, truth, limits)
    if not len(judged.stamps_ns):
        return 0.0
    end_ns = max(truth.stamps_ns[-1], judged.stamps_ns[-1])
    vouched_ns = np.minimum(np.diff(judged.stamps_ns, append=end_ns), _POSE_GAP_NS)
    return float(vouched_ns[judged.is_correct].sum() / (end_ns - truth.stamps_ns[0]))


def correct_rate_observed(
    estimate: Trajectory, truth: Trajectory, observed_ns: NDArray[np.int64], limits: CorrectLimits
) -> float:
    """Return the share of the time of a run with a correct pose, in [0, 1].

    As `correct_rate`, but only time between successive observations (N,) that the ground truth both
    covers counts, at most 1 s of each: time without observations or ground truth is left out, and a
    run that is correct at each observation gets 1. NaN when there is no such time.
    """
    known = covered(truth, observed_ns, TRUTH_GAP_S)
    begins = known[:-1][np.diff(known) == 1]
    lasts_ns = np.minimum(observed_ns[begins + 1] - observed_ns[begins], _POSE_GAP_NS)
    if not lasts_ns.sum():
        return float("nan")
    judged = _judge(estimate, truth, limits)
    if not len(judged.stamps_ns):
        return 0.0
    newest = np.searchsorted(judged.stamps_ns, observed_ns[begins], side="right") - 1
    age_ns = observed_ns[begins] - judged.stamps_ns[newest]
    holds = (newest >= 0) & (age_ns < _POSE_GAP_NS) & judged.is_correct[newest]
    return float(lasts_ns[holds].sum() / lasts_ns.sum())


def _judge(estimate: Trajectory, truth: Trajectory, limits: CorrectLimits) -> _Judged:
    index = covered(truth, estimate.stamps_ns, TRUTH_GAP_S)
    if not len(index):
        return _Judged(stamps_ns=np.zeros(0, np.int64), is_correct=np.zeros(0, bool))
    matched = select(estimate, index)
    true = interpolated(truth, matched.stamps_ns)
    # 0.1 m: on a straight path the positions alone do not determine the roll.
    T_gt_map = align(matched.T_world_base, true.T_world_base, lever_m=0.1)
    T_gt_base = T_gt_map @ matched.T_world_base
    distance_m = np.linalg.norm(T_gt_base[:, :3, 3] - true.positions_m, axis=1)
    angle_rad = se3.rotation_angle_rad(se3.inverse(true.T_world_base) @ T_gt_base)
    limit_m = limits.limit_m + limits.limit_ratio * driven_m(truth, matched.stamps_ns)
    is_correct = (distance_m <= limit_m) & (angle_rad <= limits.limit_rad)
    return _Judged(stamps_ns=matched.stamps_ns, is_correct=is_correct)
