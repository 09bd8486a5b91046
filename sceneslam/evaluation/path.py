"""Errors over segments of the path, and the ratio of path lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import associate
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SegmentErrors:
    """Error of the estimated motion over segments of the true path, one per segment."""

    trans_m: NDArray[np.float64]  # (N,)
    rot_rad: NDArray[np.float64]  # (N,)


def driven_m(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the distance (N,) [m] driven along a trajectory up to each stamp (N,)."""
    return np.interp(stamps_ns, trajectory.stamps_ns, _distances_m(trajectory.positions_m))


def segment_errors(
    estimate: Trajectory, truth: Trajectory, max_gap_s: float, segment_m: float
) -> SegmentErrors:
    """Return the errors of the estimated motion over all segments of `segment_m`.

    A segment begins at every matched pose and ends at the first one that is `segment_m` farther
    along the true path. As KITTI's odometry benchmark (Geiger et al., CVPR 2012), but over one
    length and from every pose. Neither frame has to be aligned.
    """
    matches = associate(estimate, truth, max_gap_s)
    T_map_base = estimate.T_world_base[matches.first]
    T_gt_base = truth.T_world_base[matches.second]
    ends = segment_ends(T_gt_base, segment_m)
    starts = np.flatnonzero(ends < len(ends))
    ends = ends[starts]
    T_start_end = se3.inverse(T_map_base[starts]) @ T_map_base[ends]
    T_error = se3.inverse(se3.inverse(T_gt_base[starts]) @ T_gt_base[ends]) @ T_start_end
    return SegmentErrors(
        trans_m=np.linalg.norm(T_error[:, :3, 3], axis=1), rot_rad=se3.rotation_angle_rad(T_error)
    )


def segment_ends(T_gt_base: NDArray[np.float64], segment_m: float) -> NDArray[np.int64]:
    """Return for each pose (N, 4, 4) the first that is `segment_m` farther, N where none is."""
    along_m = _distances_m(T_gt_base[:, :3, 3])
    return np.asarray(np.searchsorted(along_m, along_m + segment_m))


def length_ratio(estimate: Trajectory, truth: Trajectory, max_gap_s: float) -> float:
    """Return the ratio of the estimated to the true path length, NaN without motion.

    Both are measured over the matched poses only.
    """
    matches = associate(estimate, truth, max_gap_s)
    estimated_m = _distances_m(estimate.positions_m[matches.first])[-1:].sum()
    true_m = _distances_m(truth.positions_m[matches.second])[-1:].sum()
    return float(estimated_m / true_m) if true_m > 0 else float("nan")


def _distances_m(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance (N,) from the first position to each, along the path."""
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    return np.concatenate([np.zeros(min(len(positions_m), 1)), np.cumsum(steps_m)])
