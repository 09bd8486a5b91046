"""The oracle: in every second the motion of the module that was closest to the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

_STEP_NS = 10**9


def best_of(modules: Sequence[Trajectory], truth: Trajectory) -> Trajectory:
    """Return the trajectory of an oracle that knows, each second, which module errs least.

    It starts at the identity, and has poses at the ends of the seconds. In a second that no
    module covers it knows the true motion, so that it is a bound from below.
    """
    first_ns = int(truth.stamps_ns[0])
    count = int(truth.stamps_ns[-1] - first_ns) // _STEP_NS
    stamps_ns = first_ns + _STEP_NS * np.arange(count + 1, dtype=np.int64)
    T_gt_base = interpolated(truth, stamps_ns).T_world_base
    true = se3.inverse(T_gt_base[:-1]) @ T_gt_base[1:]
    told = np.stack([_motions(module, stamps_ns) for module in modules])  # (M, N, 4, 4)
    errors_m = np.linalg.norm((se3.inverse(true) @ told)[..., :3, 3], axis=-1)
    best = np.argmin(np.where(np.isnan(errors_m), np.inf, errors_m), axis=0)
    steps = told[best, np.arange(count)]
    steps = np.where(np.isnan(steps).any(axis=(1, 2), keepdims=True), true, steps)
    poses = [se3.identity()]
    for step in steps:
        poses.append(poses[-1] @ step)
    return Trajectory(stamps_ns=stamps_ns, T_world_base=np.stack(poses))


def _motions(module: Trajectory, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the motion of each step (N, 4, 4), NaN where the module has no pose at an end."""
    motions = np.full((len(stamps_ns) - 1, 4, 4), np.nan)
    if len(module) < 2:
        return motions
    steps_ns = np.diff(module.stamps_ns)
    following = np.clip(np.searchsorted(module.stamps_ns, stamps_ns), 1, len(module) - 1)
    is_inside = (stamps_ns >= module.stamps_ns[0]) & (stamps_ns <= module.stamps_ns[-1])
    is_told = is_inside & (steps_ns[following - 1] < _STEP_NS // 2)
    known = np.flatnonzero(is_told[:-1] & is_told[1:])
    if len(known):
        before = interpolated(module, stamps_ns[known]).T_world_base
        after = interpolated(module, stamps_ns[known + 1]).T_world_base
        motions[known] = se3.inverse(before) @ after
    return motions
