"""Absolute and relative pose error against ground truth (Sturm et al., IROS 2012)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import associate, nearest, select
from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AbsoluteErrors:
    """Distance of each matched pose from its true position, after one rigid alignment (ATE)."""

    stamps_ns: NDArray[np.int64]  # (N,), of the estimate
    errors_m: NDArray[np.float64]  # (N,)
    T_gt_map: Transform  # the alignment; identity when nothing matched

    @property
    def rmse_m(self) -> float:
        """Return the absolute trajectory error [m], NaN when nothing matched."""
        return root_mean_square(self.errors_m)

    @property
    def max_m(self) -> float:
        """Return the largest error [m], NaN when nothing matched."""
        return float(self.errors_m.max()) if len(self.errors_m) else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativeErrors:
    """Error of the estimated motion over a fixed time, one per matched pair of poses."""

    trans_m: NDArray[np.float64]  # (N,)
    rot_rad: NDArray[np.float64]  # (N,)


def absolute_errors(estimate: Trajectory, truth: Trajectory, max_gap_s: float) -> AbsoluteErrors:
    """Return the position errors of the poses that have a true pose within `max_gap_s`.

    `rmse_m` is the ATE that evo gives with `--align` (SE(3), no scale).
    """
    matches = associate(estimate, truth, max_gap_s)
    if not len(matches):
        return AbsoluteErrors(
            stamps_ns=np.zeros(0, np.int64), errors_m=np.zeros(0), T_gt_map=se3.identity()
        )
    matched = select(estimate, matches.first)
    true = select(truth, matches.second)
    T_gt_map = align(matched.T_world_base, true.T_world_base)
    moved = se3.apply(T_gt_map, matched.positions_m)
    errors_m = np.linalg.norm(moved - true.positions_m, axis=1)
    return AbsoluteErrors(stamps_ns=matched.stamps_ns, errors_m=errors_m, T_gt_map=T_gt_map)


def rotation_rmse_rad(estimate: Trajectory, truth: Trajectory, max_gap_s: float) -> float:
    """Return the RMS rotation error [rad] after one rigid alignment, NaN without matches.

    As for the Correct Rate, the alignment also uses three points 0.1 m along each pose's axes:
    positions on a straight line alone do not determine the rotation about the line.
    """
    matches = associate(estimate, truth, max_gap_s)
    if not len(matches):
        return float("nan")
    T_map_base = estimate.T_world_base[matches.first]
    T_gt_base = truth.T_world_base[matches.second]
    T_gt_map = align(T_map_base, T_gt_base, lever_m=0.1)
    return root_mean_square(se3.rotation_angle_rad(se3.inverse(T_gt_base) @ T_gt_map @ T_map_base))


def relative_errors(
    estimate: Trajectory, truth: Trajectory, max_gap_s: float, interval_s: float
) -> RelativeErrors:
    """Return the errors of all motions over `interval_s`.

    Every matched pose i with a whole interval of trajectory after it (less half a usual step) is
    paired with the matched pose j nearest to the interval's end, if that is within a tenth of the
    interval. The error is inv(inv(Q_i) Q_j) inv(P_i) P_j with true poses Q and estimates P; the
    frames need no alignment.
    """
    matches = associate(estimate, truth, max_gap_s)
    if len(matches) < 2:
        return RelativeErrors(trans_m=np.zeros(0), rot_rad=np.zeros(0))
    stamps_ns = estimate.stamps_ns[matches.first]
    wanted_ns = stamps_ns + round(interval_s * 1e9)
    later = nearest(stamps_ns, wanted_ns)
    is_near = np.abs(stamps_ns[later] - wanted_ns) <= 0.1e9 * interval_s
    is_inside = wanted_ns <= stamps_ns[-1] + np.median(np.diff(stamps_ns)) / 2
    i = np.flatnonzero(is_near & is_inside & (later > np.arange(len(later))))
    j = later[i]
    T_world_base = estimate.T_world_base[matches.first]
    T_gt_base = truth.T_world_base[matches.second]
    T_i_j = se3.inverse(T_world_base[i]) @ T_world_base[j]
    T_error = se3.inverse(se3.inverse(T_gt_base[i]) @ T_gt_base[j]) @ T_i_j
    return RelativeErrors(
        trans_m=np.linalg.norm(T_error[:, :3, 3], axis=1), rot_rad=se3.rotation_angle_rad(T_error)
    )


def root_mean_square(values: NDArray[np.float64]) -> float:
    """Return the root mean square of values (N,), NaN of an empty array."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
