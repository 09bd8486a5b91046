"""Correct Rate: for how much of the time the robot knew where it was."""

from __future__ import annotations

import numpy as np

from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import covered, interpolated, select
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

_TRUTH_GAP_S = 0.5  # ground truth is not interpolated over more
_POSE_GAP_NS = 10**9  # a pose vouches for no more than this


def correct_rate(
    estimate: Trajectory, truth: Trajectory, *, limit_m: float, limit_rad: float
) -> float:
    """Return the share of the truth's time span with a correct pose, in [0, 1].

    The definition of OpenLORIS-Scene (Shi et al., ICRA 2020): the estimate is aligned as a whole
    (SE(3), least squares, ground truth interpolated to its stamps); a pose is correct within both
    limits and then counts the time to the next pose, at most 1 s. Unlike the mean error it
    cannot be improved by giving no poses. NaN when there is no truth.
    """
    if len(truth) < 2 or truth.stamps_ns[0] == truth.stamps_ns[-1]:
        return float("nan")
    index = covered(truth, estimate.stamps_ns, _TRUTH_GAP_S)
    if not len(index):
        return 0.0
    matched = select(estimate, index)
    true = interpolated(truth, matched.stamps_ns)
    # 0.1 m: a robot that drives straight on must not fail for a roll that nothing determines.
    T_gt_map = align(matched.T_world_base, true.T_world_base, lever_m=0.1)
    T_gt_base = T_gt_map @ matched.T_world_base
    distance_m = np.linalg.norm(T_gt_base[:, :3, 3] - true.positions_m, axis=1)
    angle_rad = se3.rotation_angle_rad(se3.inverse(true.T_world_base) @ T_gt_base)
    is_correct = (distance_m <= limit_m) & (angle_rad <= limit_rad)
    end_ns = max(truth.stamps_ns[-1], matched.stamps_ns[-1])
    vouched_ns = np.minimum(np.diff(matched.stamps_ns, append=end_ns), _POSE_GAP_NS)
    return float(vouched_ns[is_correct].sum() / (end_ns - truth.stamps_ns[0]))
