"""Bundle adjustment: keyframes and landmarks that agree best with all that was measured.

Levenberg-Marquardt on the Schur complement (Triggs et al. 2000), in NumPy: the arrays of a local
window are small enough for dense algebra.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera

from .residuals import Errors, Sightings, errors
from .ties import Pulls, Ties

_ROUNDS = (5, 5)
_DAMPING = (1e-4, 1e-8, 1e4)  # of the diagonal: first, least, most
_SMALL_GAIN = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bundle:
    """Keyframes, landmarks, and which saw which where."""

    T_local_cam: NDArray[np.float64]  # (K, 4, 4)
    is_free: NDArray[np.bool_]  # (K,), False: a keyframe that only holds the others
    points_local: NDArray[np.float64]  # (L, 3) [m]
    keyframe_rows: NDArray[np.int64]  # (N,), of each sighting, rising
    landmark_rows: NDArray[np.int64]  # (N,); a keyframe sees a landmark once
    seen: Sightings  # (N,)
    ties: Ties


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjusted:
    """A bundle with its least squares solved."""

    bundle: Bundle
    agrees: NDArray[np.bool_]  # (N,), sightings whose pixel is where it should be
    information: NDArray[np.float64]  # (L, 3, 3) [1/m^2], of landmarks, were the keyframes known


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Normal:
    """The normal equations: blocks of keyframes, of landmarks, and between them."""

    poses: NDArray[np.float64]  # (F, 6, F, 6) of the free keyframes
    points: NDArray[np.float64]  # (L, 3, 3)
    between: NDArray[np.float64]  # (F, 6, L, 3)
    pose_slopes: NDArray[np.float64]  # (F, 6)
    point_slopes: NDArray[np.float64]  # (L, 3)


def adjust(camera: Camera, bundle: Bundle) -> Adjusted:
    """Return the bundle that minimises the Huber cost of its pixels and inverse depths."""
    use = np.stack([np.ones(len(bundle.keyframe_rows)), bundle.seen.measures_depth])
    for steps in _ROUNDS:
        bundle = _descend(camera, bundle, use, steps)
        found = _errors(camera, bundle)
        agrees = found.pixels_agree()
        use = np.stack([agrees, agrees & bundle.seen.measures_depth & found.depths_agree()])
    normal = _linearise(bundle, found, use, Ties.of({}).pull(bundle.T_local_cam))
    return Adjusted(bundle=bundle, agrees=agrees, information=normal.points)


def _descend(camera: Camera, bundle: Bundle, use: NDArray[np.float64], steps: int) -> Bundle:
    damping = _DAMPING[0]
    found = _errors(camera, bundle)
    pulls = bundle.ties.pull(bundle.T_local_cam)
    cost = _cost(found, use, pulls)
    for _ in range(steps):
        normal = _linearise(bundle, found, use, pulls)
        moved = _step(bundle, normal, damping)
        found_there = _errors(camera, moved)
        pulls_there = moved.ties.pull(moved.T_local_cam)
        cost_there = _cost(found_there, use, pulls_there)
        if not cost_there < cost:
            damping = min(damping * 100.0, _DAMPING[2])
            continue
        gain, bundle, found, cost = cost - cost_there, moved, found_there, cost_there
        pulls = pulls_there
        damping = max(damping * 0.1, _DAMPING[1])
        if gain < _SMALL_GAIN * cost:
            break
    return bundle


def _errors(camera: Camera, bundle: Bundle) -> Errors:
    T_cam_local = se3.inverse(bundle.T_local_cam)[bundle.keyframe_rows]
    points_local = bundle.points_local[bundle.landmark_rows]
    points_cam = np.einsum("nij,nj->ni", T_cam_local[:, :3, :3], points_local)
    return errors(camera, points_cam + T_cam_local[:, :3, 3], bundle.seen)


def _cost(found: Errors, use: NDArray[np.float64], pulls: Pulls) -> float:
    """Return the Huber cost: quadratic near zero, linear beyond."""
    weights = found.huber_weights()
    squares = np.stack([(found.of[:2] ** 2).sum(axis=0), found.of[2] ** 2])
    weight = weights[1:]
    # rho = s^2 w (2 - w): s^2 where w = 1, and 2 h s - h^2 with w = h / s.
    cost = float((use * squares * weight * (2.0 - weight)).sum())
    return cost + pulls.cost


def _linearise(bundle: Bundle, found: Errors, use: NDArray[np.float64], pulls: Pulls) -> _Normal:
    weights = np.sqrt(found.huber_weights() * use[[0, 0, 1]])
    residuals = (found.of * weights).T  # (N, 3)
    by_point_cam = np.moveaxis(found.by_point * weights[:, None], 2, 0)  # (N, 3, 3)
    rotations = bundle.T_local_cam[bundle.keyframe_rows, :3, :3]
    by_point = by_point_cam @ np.swapaxes(rotations, 1, 2)
    offsets = (
        bundle.points_local[bundle.landmark_rows] - bundle.T_local_cam[bundle.keyframe_rows, :3, 3]
    )
    points_cam = np.einsum("nji,nj->ni", rotations, offsets)
    # A twist of the camera moves a point by -rho + point x phi.
    by_pose = np.concatenate([-by_point_cam, np.cross(by_point_cam, points_cam[:, None])], axis=2)
    normal = _assemble(bundle, residuals, by_pose, by_point)
    blocks = np.swapaxes(normal.poses, 1, 2)
    pulls.add_to(blocks, normal.pose_slopes, bundle.is_free)
    return normal


def _assemble(
    bundle: Bundle,
    residuals: NDArray[np.float64],
    by_pose: NDArray[np.float64],
    by_point: NDArray[np.float64],
) -> _Normal:
    count = len(bundle.points_local)
    flat = np.einsum("nri,nrj->ijn", by_point, by_point).reshape(9, -1)
    points = np.stack([np.bincount(bundle.landmark_rows, row, count) for row in flat], axis=1)
    slopes = np.einsum("nri,nr->in", by_point, residuals)
    point_slopes = np.stack([np.bincount(bundle.landmark_rows, row, count) for row in slopes], 1)
    free = np.cumsum(bundle.is_free) - 1
    starts = np.searchsorted(bundle.keyframe_rows, np.arange(len(bundle.is_free) + 1))
    total = int(bundle.is_free.sum())
    poses, pose_slopes = np.zeros((total, 6, total, 6)), np.zeros((total, 6))
    between = np.zeros((total, 6, count, 3))
    for row in np.flatnonzero(bundle.is_free):
        these = slice(starts[row], starts[row + 1])
        jacobian = by_pose[these].reshape(-1, 6)
        poses[free[row], :, free[row]] = jacobian.T @ jacobian
        pose_slopes[free[row]] = jacobian.T @ residuals[these].ravel()
        blocks = np.swapaxes(by_pose[these], 1, 2) @ by_point[these]  # (n, 6, 3)
        between[free[row]][:, bundle.landmark_rows[these]] = np.swapaxes(blocks, 0, 1)
    return _Normal(
        poses=poses,
        points=points.reshape(count, 3, 3).astype(np.float64),
        between=between,
        pose_slopes=pose_slopes,
        point_slopes=point_slopes.astype(np.float64),
    )


def _step(bundle: Bundle, normal: _Normal, damping: float) -> Bundle:
    """Return the bundle after one step of the damped normal equations."""
    size = 6 * len(normal.poses)
    poses = _damped(normal.poses.reshape(1, size, size), damping)[0]
    inverses = np.linalg.inv(_damped(normal.points, damping))
    between = normal.between.reshape(size, -1, 3)
    eliminated = (np.swapaxes(between, 0, 1) @ inverses).swapaxes(0, 1)  # (6F, L, 3)
    left = poses - eliminated.reshape(size, -1) @ between.reshape(size, -1).T
    right = normal.pose_slopes.ravel() - eliminated.reshape(size, -1) @ normal.point_slopes.ravel()
    twists = np.asarray(-np.linalg.solve(left, right), np.float64)
    pulled = normal.point_slopes + np.tensordot(twists, between, 1)
    moves = -np.einsum("lij,lj->li", inverses, pulled)
    T_local_cam = bundle.T_local_cam.copy()
    for row, twist in zip(np.flatnonzero(bundle.is_free), twists.reshape(-1, 6), strict=True):
        T_local_cam[row] = T_local_cam[row] @ se3.exp(twist)
    return replace(bundle, T_local_cam=T_local_cam, points_local=bundle.points_local + moves)


def _damped(blocks: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
    """Return the blocks (M, n, n) with more on their diagonals; never singular."""
    size = blocks.shape[1]
    diagonals = np.einsum("mii->mi", blocks)
    return np.asarray(blocks + (damping * diagonals + 1e-9)[:, :, None] * np.eye(size))
