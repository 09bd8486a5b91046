"""The rigid transform that aligns one trajectory with another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform


def align(
    T_source_base: NDArray[np.float64], T_target_base: NDArray[np.float64], lever_m: float = 0.0
) -> Transform:
    """Return T_target_source that minimises the squared distance of paired poses (N, 4, 4).

    Umeyama (PAMI 1991) without scale. With `lever_m` above 0, three points at that distance along
    each pose's axes are aligned, too. They determine the rotation about a straight path, which
    positions alone do not, and hardly change the result otherwise. A path without extent (one
    pose, or standing still) is always aligned in this way; N has to be at least 1.
    """
    source, target = T_source_base[:, :3, 3], T_target_base[:, :3, 3]
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    cross = (target - target_mean).T @ (source - source_mean) / len(source)
    axes = np.einsum("nij,nkj->ik", T_target_base[:, :3, :3], T_source_base[:, :3, :3])
    spread = np.linalg.svd(cross, compute_uv=False)
    if spread[1] <= 1e-9 * spread[0] or spread[0] < 1e-12:
        lever_m = max(lever_m, 0.1)
    rotation = _nearest_rotation(cross + lever_m**2 * axes / len(source))
    return se3.from_parts(rotation, target_mean - rotation @ source_mean)


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation with the largest trace(R.T @ matrix), never a reflection."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    return np.asarray(u @ np.diag([1.0, 1.0, sign]) @ vt)
