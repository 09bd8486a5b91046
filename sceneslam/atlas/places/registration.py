"""Register one floor plan to another: point-to-line, with covariance and contradictions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.places.floor_plan import CELL_M
from sceneslam.atlas.places.plan_field import NearestWalls, PlanField
from sceneslam.types import planar
from sceneslam.types.planar import Matrix, Planar

_KERNELS_M = (0.4, 0.2, 0.1)  # of the robust weight: coarse to fine
_ITERATIONS = 10  # at most, per kernel
_FEW, _HOPELESS = 120, 0.5  # wall points for the first kernel; unmatched share that rejects a start
_CONVERGED = np.array([1e-4, 1e-4, 5e-5])  # m, m, rad
_INLIER_M = 0.1  # two cells
_NOISE_MIN_M = CELL_M / np.sqrt(12.0)  # uniform distribution of a point in its cell
_CORRELATION = 10.0  # cells of one wall have common errors over 0.5 m
_COMMON = np.array([0.005, 0.005, 0.002])  # m, m, rad: of a whole plan, as its poses drift
_HELD_RATIO = 0.03  # least share of the walls that constrains a direction
_OTHER_MAX = 0.2  # share of walls that may have moved: doors, furniture
_OPEN = 25.0  # m^2, rad^2: variance in unconstrained directions, twice a submap's size


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanRegistration:
    """The pose of a query plan in a target plan, with its quality."""

    T_target_query: Planar
    covariance: Matrix  # (3, 3), axes of the query
    weak_directions: int  # 0 to 3, that the walls do not constrain
    inlier_ratio: float  # share of the walls in known space that lie on a wall
    known_ratio: float  # share of the walls in known space of the target
    conflict_ratio: float  # share of walls of either that lie in free space of the other

    @property
    def is_verified(self) -> bool:
        """Tell whether both plans agree, except for a share that may have moved."""
        return self.inlier_ratio >= 1.0 - _OTHER_MAX and self.conflict_ratio <= _OTHER_MAX

    @property
    def is_refuted(self) -> bool:
        """Tell whether the plans differ by more than twice the share that may have moved."""
        is_off = self.inlier_ratio < 1.0 - 2.0 * _OTHER_MAX
        return is_off or self.conflict_ratio > 2.0 * _OTHER_MAX


def register(query: PlanField, target: PlanField, start: Planar) -> PlanRegistration:
    """Return T_target_query (3,), from a start (3,) within about 0.5 m and 0.2 rad."""
    walls = _Walls.of(query)
    few, pose = walls.thinned(), planar.compose(start, walls.T_query_centre)
    pose = _refined(few, target, pose, _KERNELS_M[0])
    far_m = target.nearest(planar.apply(pose, few.points)).distance_m
    if (far_m <= _KERNELS_M[0]).mean() >= _HOPELESS:
        for kernel_m in _KERNELS_M[1:]:
            pose = _refined(walls, target, pose, kernel_m)
    return _judged(query, walls, target, pose)


def _refined(walls: _Walls, target: PlanField, pose: Planar, kernel_m: float) -> Planar:
    """Return the centre's pose after Gauss-Newton iterations with a robust weight."""
    for _ in range(_ITERATIONS):
        H, g, _, _ = _equations(walls, target, pose, kernel_m)
        H, _ = _held(H, walls.spread_m)
        step = -np.linalg.pinv(H, rcond=1e-9, hermitian=True) @ g
        pose = planar.compose(pose, step)
        if np.all(np.abs(step) < _CONVERGED):
            break
    return pose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Walls:
    """A query's walls relative to their centre, so that rotation and translation decouple."""

    points: NDArray[np.float64]  # (N, 2) [m]
    normals: NDArray[np.float64]  # (N, 2)
    T_query_centre: Planar
    spread_m: float

    @classmethod
    def of(cls, query: PlanField) -> _Walls:
        points = query.plan.points.astype(np.float64)
        centre = points.mean(axis=0)
        return cls(
            points=points - centre,
            normals=query.plan.normals.astype(np.float64),
            T_query_centre=np.array([*centre, 0.0]),
            spread_m=max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())), CELL_M),
        )

    def thinned(self) -> _Walls:
        """Return a subset of the walls, which suffices for the first kernel."""
        stride = max(1, len(self.points) // _FEW)
        return replace(self, points=self.points[::stride], normals=self.normals[::stride])


def _equations(
    walls: _Walls, target: PlanField, pose: Planar, kernel_m: float
) -> tuple[Matrix, NDArray[np.float64], float, float]:
    """Return H (3, 3) and g (3,) of a step, the sum of weights and the squared error."""
    points, own_normals = walls.points, walls.normals
    turn = planar.rotation(float(pose[2]))
    near = target.nearest(points @ turn.T + pose[:2])
    error, normals = near.error @ turn, near.normals @ turn  # in the query's axes
    is_line = (normals != 0).any(axis=1) & (own_normals != 0).any(axis=1)
    is_line &= (normals * own_normals).sum(axis=1) > 0.7  # the same side of a wall
    across = (error * normals).sum(axis=1)
    along = np.sqrt(np.maximum(near.distance_m**2 - across**2, 0.0))
    weight = (kernel_m**2 / (kernel_m**2 + across**2)) ** 2
    weight *= is_line & (np.abs(across) < 2 * kernel_m) & (along < max(kernel_m, 2 * CELL_M))
    rows = np.column_stack([normals, points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]])
    H = rows.T @ (rows * weight[:, None])
    return H, rows.T @ (weight * across), float(weight.sum()), float(weight @ across**2)


def _held(H: Matrix, spread_m: float) -> tuple[Matrix, int]:
    """Return H without unconstrained directions, and the number of these."""
    total = float(H[0, 0] + H[1, 1])  # the normals are unit vectors
    if total <= 0:
        return np.zeros((3, 3)), 3
    scale = np.array([1.0, 1.0, 1.0 / spread_m])
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale) / total)
    keep = vectors[:, values > _HELD_RATIO]
    project = keep @ keep.T
    kept = project @ (vectors * values) @ vectors.T @ project
    inverse = 1.0 / scale
    return np.asarray(total * np.outer(inverse, inverse) * kept), 3 - keep.shape[1]


def _judged(query: PlanField, walls: _Walls, target: PlanField, pose: Planar) -> PlanRegistration:
    H, _, total, squared = _equations(walls, target, pose, _KERNELS_M[-1])
    H, weak = _held(H, walls.spread_m)
    noise_m2 = max(squared / max(total, 1e-9), _NOISE_MIN_M**2)
    values, vectors = np.linalg.eigh(H / (noise_m2 * _CORRELATION))
    variances = np.where(values > 1.0 / _OPEN, 1.0 / np.maximum(values, 1.0 / _OPEN), _OPEN)
    T_centre_query = planar.between(walls.T_query_centre, np.zeros(3))
    covariance = (vectors * variances) @ vectors.T + np.diag(_COMMON**2)
    covariance = planar.propagate(covariance, np.zeros(3), T_centre_query, np.zeros((3, 3)))
    here = target.nearest(planar.apply(pose, walls.points))
    known = int(here.is_known.sum())
    inliers = int((here.distance_m <= _INLIER_M).sum())
    T_target_query = planar.compose(pose, T_centre_query)
    return PlanRegistration(
        T_target_query=T_target_query,
        covariance=np.asarray(covariance),
        weak_directions=weak,
        inlier_ratio=inliers / max(known, 1),
        known_ratio=known / max(len(walls.points), 1),
        conflict_ratio=max(_conflicts(here), _conflicts(_back(query, target, T_target_query))),
    )


def _back(query: PlanField, target: PlanField, pose: Planar) -> NearestWalls:
    """Return the query's walls and free space at the target's walls."""
    T_query_target = planar.between(pose, np.zeros(3))
    return query.nearest(planar.apply(T_query_target, target.plan.points.astype(np.float64)))


def _conflicts(nearest: NearestWalls) -> float:
    """Return the share of walls in known space of the other plan that lie in its free space."""
    known = int(nearest.is_known.sum())
    return int((nearest.is_known & nearest.is_clear).sum()) / max(known, 1)
