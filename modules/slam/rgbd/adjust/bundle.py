"""Bundle adjustment: the keyframes and landmarks that best fit all measurements.

Levenberg-Marquardt on the Schur complement (Triggs et al. 2000), in NumPy: the arrays of a local
window are small enough for dense algebra.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera

from ..locate.residuals import Errors, Sightings, errors
from .pose_constraints import ConstraintResiduals, PoseConstraints

_ROUNDS = (5, 5)
_DAMPING = (1e-4, 1e-8, 1e4)  # of the diagonal: first, least, most
_SMALL_GAIN = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bundle:
    """Keyframes, landmarks, and the sightings that connect them."""

    T_local_cam: NDArray[np.float64]  # (K, 4, 4)
    is_free: NDArray[np.bool_]  # (K,), False: a fixed keyframe
    points_local: NDArray[np.float64]  # (L, 3) [m]
    keyframe_rows: NDArray[np.int64]  # (N,), of each sighting, ascending
    landmark_rows: NDArray[np.int64]  # (N,); a keyframe sees a landmark once
    seen: Sightings  # (N,)
    constraints: PoseConstraints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjusted:
    """A bundle after optimisation."""

    bundle: Bundle
    agrees: NDArray[np.bool_]  # (N,), sightings whose pixel agrees
    information: NDArray[np.float64]  # (L, 3, 3) [1/m^2], of landmarks, given the keyframes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Slopes:
    """Weighted residuals and their Jacobians by keyframes and landmarks."""

    residuals: NDArray[np.float64]  # (3, N)
    by_pose: NDArray[np.float64]  # (6, 3, N), by a twist of the camera
    by_point: NDArray[np.float64]  # (3, 3, N): residual, component of the point in local


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Normal:
    """The normal equations: blocks of keyframes, of landmarks, and between them."""

    poses: NDArray[np.float64]  # (F, 6, F, 6) of the free keyframes
    points: NDArray[np.float64]  # (L, 3, 3)
    between: NDArray[np.float64]  # (F, 6, 3, L)
    pose_slopes: NDArray[np.float64]  # (F, 6)
    point_slopes: NDArray[np.float64]  # (3, L)


def adjust(camera: Camera, bundle: Bundle) -> Adjusted:
    """Return the bundle that minimises the Huber cost of its pixels and inverse depths."""
    use = np.stack([np.ones(len(bundle.keyframe_rows)), bundle.seen.measures_depth])
    for steps in _ROUNDS:
        bundle = _descend(camera, bundle, use, steps)
        found = _errors(camera, bundle)
        agrees = found.pixels_agree()
        use = np.stack([agrees, agrees & bundle.seen.measures_depth & found.depths_agree()])
    information = _point_blocks(bundle, _slopes(bundle, found, use))
    return Adjusted(bundle=bundle, agrees=agrees, information=information)


def _descend(camera: Camera, bundle: Bundle, use: NDArray[np.float64], steps: int) -> Bundle:
    damping, normal = _DAMPING[0], None
    found, off = _errors(camera, bundle), bundle.constraints.residuals_at(bundle.T_local_cam)
    cost = _cost(found, use, off)
    for _ in range(steps):
        if normal is None:
            normal = _assemble(bundle, _slopes(bundle, found, use), off)
        moved = _step(bundle, normal, damping)
        found_there, off_there = (
            _errors(camera, moved),
            moved.constraints.residuals_at(moved.T_local_cam),
        )
        cost_there = _cost(found_there, use, off_there)
        if not cost_there < cost:
            damping = min(damping * 100.0, _DAMPING[2])
            continue
        gain, bundle, found, cost = cost - cost_there, moved, found_there, cost_there
        off, normal = off_there, None
        damping = max(damping * 0.1, _DAMPING[1])
        if gain < _SMALL_GAIN * cost:
            break
    return bundle


def _rotations(bundle: Bundle) -> NDArray[np.float64]:
    """Return R_local_cam (3, 3, N) of each sighting."""
    by_keyframe = np.ascontiguousarray(np.moveaxis(bundle.T_local_cam[:, :3, :3], 0, 2))
    return np.take(by_keyframe, bundle.keyframe_rows, axis=2)


def _errors(camera: Camera, bundle: Bundle) -> Errors:
    viewers_local = bundle.T_local_cam[bundle.keyframe_rows, :3, 3]
    rays_local = bundle.points_local[bundle.landmark_rows] - viewers_local
    points_cam = np.einsum("jin,nj->in", _rotations(bundle), rays_local)
    return errors(camera, points_cam, bundle.seen)


def _cost(found: Errors, use: NDArray[np.float64], off: ConstraintResiduals) -> float:
    """Return the Huber cost: quadratic near zero, linear beyond."""
    squares = np.stack([(found.of[:2] ** 2).sum(axis=0), found.of[2] ** 2])
    weight = found.huber_weights()[1:]
    # rho = s^2 w (2 - w): s^2 where w = 1, and 2 h s - h^2 with w = h / s.
    cost = float((use * squares * weight * (2.0 - weight)).sum())
    return cost + off.cost


def _slopes(bundle: Bundle, found: Errors, use: NDArray[np.float64]) -> _Slopes:
    weights = np.sqrt(found.huber_weights() * use[[0, 0, 1]])
    by_point_cam = found.by_point * weights[:, None]
    return _Slopes(
        residuals=found.of * weights,
        by_pose=found.by_twist() * weights,
        by_point=np.einsum("rin,jin->rjn", by_point_cam, _rotations(bundle)),
    )


def _point_blocks(bundle: Bundle, slopes: _Slopes) -> NDArray[np.float64]:
    """Return the landmarks' information (L, 3, 3), given the keyframes."""
    squares = np.einsum("rin,rjn->ijn", slopes.by_point, slopes.by_point).reshape(9, -1)
    return _per_landmark(bundle, squares).T.reshape(-1, 3, 3)


def _per_landmark(bundle: Bundle, rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sums (R, L), over each landmark's sightings, of rows (R, N)."""
    count = len(bundle.points_local)
    return np.stack([np.bincount(bundle.landmark_rows, row, count) for row in rows])


def _assemble(bundle: Bundle, slopes: _Slopes, off: ConstraintResiduals) -> _Normal:
    point_slopes = np.einsum("rin,rn->in", slopes.by_point, slopes.residuals)
    free = np.cumsum(bundle.is_free) - 1
    starts = np.searchsorted(bundle.keyframe_rows, np.arange(len(bundle.is_free) + 1))
    total = int(bundle.is_free.sum())
    poses, pose_slopes = np.zeros((total, 6, total, 6)), np.zeros((total, 6))
    between = np.zeros((total, 6, 3, len(bundle.points_local)))
    for row in np.flatnonzero(bundle.is_free):
        these = slice(starts[row], starts[row + 1])
        by_pose = slopes.by_pose[:, :, these]
        jacobian = by_pose.reshape(6, -1)
        poses[free[row], :, free[row]] = jacobian @ jacobian.T
        pose_slopes[free[row]] = jacobian @ slopes.residuals[:, these].ravel()
        blocks = np.einsum("arn,rcn->acn", by_pose, slopes.by_point[:, :, these])
        between[free[row]][:, :, bundle.landmark_rows[these]] = blocks
    off.add_to(np.swapaxes(poses, 1, 2), pose_slopes, bundle.is_free)
    return _Normal(
        poses=poses,
        points=_point_blocks(bundle, slopes),
        between=between,
        pose_slopes=pose_slopes,
        point_slopes=_per_landmark(bundle, point_slopes),
    )


def _step(bundle: Bundle, normal: _Normal, damping: float) -> Bundle:
    """Return the bundle after one step of the damped normal equations."""
    size = 6 * len(normal.poses)
    poses = _damped(normal.poses.reshape(1, size, size), damping)[0]
    inverses = np.moveaxis(np.linalg.inv(_damped(normal.points, damping)), 0, 2).copy()
    between = normal.between.reshape(size, -1)
    eliminated = np.einsum("adl,dcl->acl", between.reshape(size, 3, -1), inverses)
    eliminated = eliminated.reshape(size, -1)
    left = poses - eliminated @ between.T
    right = normal.pose_slopes.ravel() - eliminated @ normal.point_slopes.ravel()
    twists = np.asarray(-np.linalg.solve(left, right), np.float64)
    pulled = normal.point_slopes + (twists @ between).reshape(3, -1)
    moves = -np.einsum("dcl,cl->ld", inverses, pulled)
    T_local_cam = bundle.T_local_cam.copy()
    for row, twist in zip(np.flatnonzero(bundle.is_free), twists.reshape(-1, 6), strict=True):
        T_local_cam[row] = T_local_cam[row] @ se3.exp(twist)
    return replace(bundle, T_local_cam=T_local_cam, points_local=bundle.points_local + moves)


def _damped(blocks: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
    """Return the blocks (M, n, n) with damped diagonals; never singular."""
    size = blocks.shape[1]
    diagonals = np.einsum("mii->mi", blocks)
    return np.asarray(blocks + (damping * diagonals + 1e-9)[:, :, None] * np.eye(size))
