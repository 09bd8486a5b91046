"""Errors over segments of the path, and the ratio of path lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import associate
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

_GAP_S = 1.0  # without a pose: the true path is longer than the way across it
_LONGER_RATIO = 1.5  # than wanted: a segment that ends after a gap


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentErrors:
    """Error of the estimated motion over segments of the true path, one per segment."""

    trans_m: NDArray[np.float64]  # (N,)
    rot_rad: NDArray[np.float64]  # (N,)


def driven_m(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the distance (N,) [m] driven along a trajectory up to each stamp (N,)."""
    return np.interp(stamps_ns, trajectory.stamps_ns, distances_m(trajectory.positions_m))


def segment_errors(
    estimate: Trajectory, truth: Trajectory, max_gap_s: float, segment_m: float
) -> SegmentErrors:
    """Return the errors of the estimated motion over all segments of `segment_m`.

    A segment begins at every matched pose and ends at the first one that is `segment_m` farther
    along the true path. As KITTI's odometry benchmark (Geiger et al., CVPR 2012), but over one
    length and from every pose; where there is no pose to end at, there is no segment. Neither frame
    has to be aligned.
    """
    matches = associate(estimate, truth, max_gap_s)
    T_map_base = estimate.T_world_base[matches.first]
    T_gt_base = truth.T_world_base[matches.second]
    along_m = _along_m(truth, matches.second)
    ends = segment_ends(along_m, segment_m)
    starts = np.flatnonzero(ends < len(ends))
    starts = starts[along_m[ends[starts]] - along_m[starts] <= _LONGER_RATIO * segment_m]
    ends = ends[starts]
    T_start_end = se3.inverse(T_map_base[starts]) @ T_map_base[ends]
    T_error = se3.inverse(se3.inverse(T_gt_base[starts]) @ T_gt_base[ends]) @ T_start_end
    return SegmentErrors(
        trans_m=np.linalg.norm(T_error[:, :3, 3], axis=1), rot_rad=se3.rotation_angle_rad(T_error)
    )


def segment_ends(along_m: NDArray[np.float64], segment_m: float) -> NDArray[np.int64]:
    """Return for each pose, by its distance along the path (N,), the first that is a segment on.

    N where none is.
    """
    return np.asarray(np.searchsorted(along_m, along_m + segment_m))


def length_ratio(estimate: Trajectory, truth: Trajectory, max_gap_s: float) -> float:
    """Return the ratio of the estimated to the true path length, NaN without motion.

    Both are measured over the matched poses only.
    """
    matches = associate(estimate, truth, max_gap_s)
    estimated_m = distances_m(estimate.positions_m[matches.first])[-1:].sum()
    true_m = distances_m(truth.positions_m[matches.second])[-1:].sum()
    return float(estimated_m / true_m) if true_m > 0 else float("nan")


def _along_m(truth: Trajectory, index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the distance (N,) along the true path of some of its poses (N,)."""
    if not len(index):
        return np.zeros(0)
    stamps_ns = truth.stamps_ns[index]
    steps_m = np.diff(distances_m(truth.positions_m[index]), prepend=0.0)
    driven = np.diff(driven_m(truth, stamps_ns), prepend=0.0)
    is_gap = np.diff(stamps_ns, prepend=stamps_ns[:1]) > _GAP_S * 1e9
    return np.cumsum(np.where(is_gap, driven, steps_m))


def distances_m(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance (N,) from the first position to each, along the path."""
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    return np.concatenate([np.zeros(min(len(positions_m), 1)), np.cumsum(steps_m)])
