"""Associate poses with stamps: nearest in time, or interpolated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePairs:
    """Pairs of poses of two trajectories: `first[k]` belongs to `second[k]`."""

    first: Indices
    second: Indices

    def __len__(self) -> int:
        return len(self.first)


def nearest(stamps_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> Indices:
    """Return (M,) the index of the nearest of `stamps_ns` (N,), sorted, for each of `wanted_ns`.

    Of two equally near stamps it is the earlier one.
    """
    right = np.clip(np.searchsorted(stamps_ns, wanted_ns), 0, len(stamps_ns) - 1)
    left = np.maximum(right - 1, 0)
    left_is_nearer = wanted_ns - stamps_ns[left] <= np.abs(stamps_ns[right] - wanted_ns)
    index = np.where(left_is_nearer, left, right)
    return np.searchsorted(stamps_ns, stamps_ns[index])  # the first of equal stamps


def associate(first: Trajectory, second: Trajectory, max_gap_s: float) -> PosePairs:
    """Return, for each pose of the shorter trajectory, the nearest of the longer.

    Pairs farther apart than `max_gap_s` are left out, as in evo (`sync.associate_trajectories`), so
    that numbers can be compared.
    """
    if len(second) <= len(first):
        swapped = _nearest_within(second.stamps_ns, first.stamps_ns, max_gap_s)
        return PosePairs(first=swapped.second, second=swapped.first)
    return _nearest_within(first.stamps_ns, second.stamps_ns, max_gap_s)


def select(trajectory: Trajectory, index: Indices) -> Trajectory:
    """Return the poses at the indices (N,)."""
    return Trajectory(
        stamps_ns=trajectory.stamps_ns[index], T_world_base=trajectory.T_world_base[index]
    )


def clip(trajectory: Trajectory, start_ns: int, end_ns: int) -> Trajectory:
    """Return the poses from the last up to `start_ns` to the first from `end_ns` on.

    Each instant of the span thus keeps its neighbours on both sides.
    """
    first = int(np.searchsorted(trajectory.stamps_ns, start_ns, side="right")) - 1
    last = int(np.searchsorted(trajectory.stamps_ns, end_ns))
    return select(trajectory, np.arange(max(first, 0), min(last + 1, len(trajectory))))


def covered(trajectory: Trajectory, stamps_ns: NDArray[np.int64], max_gap_s: float) -> Indices:
    """Return the indices (M,) of stamps (N,) with poses at most `max_gap_s` away on both sides."""
    if not len(trajectory):
        return np.zeros(0, np.int64)
    times = trajectory.stamps_ns
    right = np.searchsorted(times, stamps_ns)
    inside = (stamps_ns >= times[0]) & (stamps_ns <= times[-1])
    right = np.clip(right, 0, len(times) - 1)
    left = np.where(times[right] == stamps_ns, right, np.maximum(right - 1, 0))
    max_gap_ns = max_gap_s * 1e9
    near = (stamps_ns - times[left] <= max_gap_ns) & (times[right] - stamps_ns <= max_gap_ns)
    return np.flatnonzero(inside & near)


def interpolated(trajectory: Trajectory, stamps_ns: NDArray[np.int64]) -> Trajectory:
    """Return the poses at the stamps (N,), which the trajectory has to cover.

    Positions are interpolated linearly, rotations by slerp.
    """
    times = trajectory.stamps_ns
    right = np.clip(np.searchsorted(times, stamps_ns), min(1, len(times) - 1), len(times) - 1)
    left = np.maximum(right - 1, 0)
    span_ns = np.maximum(times[right] - times[left], 1)
    ratio = (stamps_ns - times[left]) / span_ns
    before, after = trajectory.T_world_base[left], trajectory.T_world_base[right]
    return Trajectory(stamps_ns=stamps_ns, T_world_base=se3.interpolate(before, after, ratio))


def _nearest_within(
    short_ns: NDArray[np.int64], long_ns: NDArray[np.int64], max_gap_s: float
) -> PosePairs:
    if not len(short_ns) or not len(long_ns):
        return PosePairs(first=np.zeros(0, np.int64), second=np.zeros(0, np.int64))
    partner = nearest(long_ns, short_ns)
    kept = np.flatnonzero(np.abs(long_ns[partner] - short_ns) <= round(max_gap_s * 1e9))
    return PosePairs(first=kept, second=partner[kept])
