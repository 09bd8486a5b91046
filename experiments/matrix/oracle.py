"""The oracle: the best choice of one module per piece of the drive, knowing the true trajectory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import interpolated
from sceneslam.evaluation.path import distances_m, segment_ends
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

_STEP_S = 0.2  # the drive is looked at so often
_GAP_NS = 5 * 10**8  # an estimate without a pose for so long has none there
_BEAM = 256  # choices that are followed at a time


def best_of(
    estimates: Sequence[Trajectory], truth: Trajectory, piece_s: float, segment_m: float
) -> Trajectory:
    """Return the trajectory of an oracle that knows how far each estimate errs in each piece.

    The modules ran side by side over the whole drive; the estimates are what they reported online
    and at the end. The drive is cut into pieces of `piece_s`. The motion of a piece is that of one
    estimate, from where the piece before it ended. Of all choices (a beam search) it is the one
    whose error over segments of `segment_m` is smallest, in the root mean square. In a piece that
    none covers it knows the true motion.
    """
    stamps_ns = _stamps_ns(truth)
    true = interpolated(truth, stamps_ns).T_world_base
    known = [_poses(estimate, stamps_ns) for estimate in estimates]
    ends = segment_ends(distances_m(true[:, :3, 3]), segment_m)
    poses = se3.identity()[None, None]  # (choices, poses so far, 4, 4)
    cost_m2 = np.zeros(1)  # of all segments that have ended
    for piece in _pieces(len(stamps_ns), piece_s):
        motions = [_motion(one[piece]) for one in [*known, true]]
        offered = [motion for motion in motions[:-1] if not np.isnan(motion).any()] or motions[-1:]
        poses = np.concatenate([_continued(poses, motion) for motion in offered])
        cost_m2 = np.tile(cost_m2, len(offered))
        ended = np.flatnonzero((ends > piece.start) & (ends < piece.stop))
        cost_m2 += _errors_m2(poses, true, ended, ends[ended])
        last = piece.stop - 1
        begun = np.flatnonzero(ends[:last] > last)
        best = np.argsort(
            cost_m2 + _errors_m2(poses, true, begun, np.full(len(begun), last)), kind="stable"
        )[:_BEAM]
        poses, cost_m2 = poses[best], cost_m2[best]
    return Trajectory(stamps_ns=stamps_ns, T_world_base=poses[np.argmin(cost_m2)])


def _stamps_ns(truth: Trajectory) -> NDArray[np.int64]:
    first_ns, last_ns = truth.stamps_ns[[0, -1]]
    step_ns = round(_STEP_S * 1e9)
    return np.asarray(np.arange(first_ns, last_ns + 1, step_ns, dtype=np.int64))


def _pieces(count: int, piece_s: float) -> Iterator[slice]:
    """Yield the pieces of a drive; one begins with the pose that the one before ended with."""
    length = max(round(piece_s / _STEP_S), 1)
    for first, last in pairwise([*range(0, count - 1, length), count - 1]):
        yield slice(first, last + 1)


def _poses(estimate: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return an estimate's poses (N, 4, 4), NaN where it has none."""
    poses = np.full((len(stamps_ns), 4, 4), np.nan)
    if len(estimate) < 2:
        return poses
    following = np.clip(np.searchsorted(estimate.stamps_ns, stamps_ns), 1, len(estimate) - 1)
    is_inside = (stamps_ns >= estimate.stamps_ns[0]) & (stamps_ns <= estimate.stamps_ns[-1])
    is_covered = is_inside & (np.diff(estimate.stamps_ns)[following - 1] < _GAP_NS)
    poses[is_covered] = interpolated(estimate, stamps_ns[is_covered]).T_world_base
    return poses


def _motion(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses (N - 1, 4, 4) after the first one, seen from it."""
    return np.asarray(se3.inverse(poses[0]) @ poses[1:])


def _continued(poses: NDArray[np.float64], motion: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([poses, poses[:, -1:] @ motion], axis=1)


def _errors_m2(
    poses: NDArray[np.float64],
    true: NDArray[np.float64],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the squared errors [m^2] of each choice's motions, added up."""
    T_start_end = se3.inverse(poses[:, starts]) @ poses[:, ends]
    due = se3.inverse(true[starts]) @ true[ends]
    return np.asarray(np.sum((T_start_end - due)[..., :3, 3] ** 2, axis=(1, 2)))
