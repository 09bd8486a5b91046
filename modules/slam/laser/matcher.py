"""Scan matching: a correlative search around the prediction, then Gauss-Newton with the prior.

The search (after Olson, "Real-time correlative scan matching", ICRA 2009) finds the basin; the
refinement is point-to-line where the map holds lines, with the prediction as one more measurement.
Directions that the geometry does not hold are taken out of the laser's information (after Zhang,
Kaess, Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016), so that
there the prior alone decides.

What a scan made of a band of heights shows is not quite a wall: which of the things in the band is
the nearest changes with the view, for many beams together. Such an error does not average out over
beams, nor over scans taken from almost the same place.

Where the map ends, what lies beyond is no part of its last surface: pairs there are dropped (after
Turk and Levoy, "Zippered polygon meshes from range images", SIGGRAPH 1994). Kept, they turn a robot
that turns against its turn: on that side of the view there is always more than in the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .field import LikelihoodField
from .planar import Matrix, Planar, rotation, wrap
from .surface import SurfacePoints

_SEARCH_POINTS = 120  # more do not change the coarse answer
_SEARCH_STEP_M = 0.1
_SEARCH_SIGMAS = 3.0
_PRIOR_WEIGHT = 0.01  # likelihood per squared sigma from the prediction
_KERNELS_M = (0.25, 0.12, 0.06)  # of the robust weight: coarse to fine
_ITERATIONS = (3, 3, 8)  # at most, per kernel
_CONVERGED = np.array([3e-4, 3e-4, 1e-4])  # m, m, rad: a step this small is the last
_INLIER_M = 0.1
_END_M = 0.1  # a mapped surface may go on so far, or twice as far as the beams are apart
_CORRELATION = 4.0  # neighbouring beams share their errors: information is this much less
_VIEW_M, _VIEW_RAD = 0.1, 0.1  # scans taken so far apart err each in its own way
_NOVELTY_MIN = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """A scan's pose in the local map."""

    T_local_base: Planar
    information: Matrix  # of the laser alone, as if nothing was seen before; axes of local
    covariance: Matrix  # of the pose: laser and prior together, axes of local
    inliers: int
    inlier_ratio: float
    overlap_ratio: float  # share of points where the map has anything near
    weak_directions: int  # 0 to 3: how many the geometry does not hold


@dataclass(slots=True)
class Matcher:
    """Fits scans into a likelihood field."""

    window_m: float
    window_rad: float
    degeneracy_ratio: float
    shift_m: float  # standard deviation of what a scan's points are off by together

    def match(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        predicted: Planar,
        prior: Matrix,
        *,
        novelty: float = 1.0,
    ) -> Match:
        """Return the pose of a scan near `predicted`, whose covariance is `prior`.

        `novelty` (0 to 1): how much of its error it does not share with the scan before; 1 where
        the prediction is a guess, which outweighs no scan.
        """
        information = np.asarray(np.linalg.inv(prior), dtype=np.float64)
        found = self._search(scan_base, field, predicted, prior)
        candidates = [predicted] if np.array_equal(found, predicted) else [predicted, found]
        shift_m = self.shift_m / float(np.sqrt(novelty))
        refined = [
            self._refine(scan_base, field, start, predicted, information, shift_m)
            for start in candidates
        ]
        return max(refined, key=lambda match: match.inlier_ratio)

    def refine(
        self, scan_base: SurfacePoints, field: LikelihoodField, start: Planar, prior: Matrix
    ) -> Match:
        """Return the pose of a scan at `start`, whose covariance is `prior`, without a search."""
        information = np.asarray(np.linalg.inv(prior), dtype=np.float64)
        return self._refine(scan_base, field, start, start, information, self.shift_m)

    def _search(
        self, scan_base: SurfacePoints, field: LikelihoodField, predicted: Planar, prior: Matrix
    ) -> Planar:
        """Return the likeliest pose on a grid around the prediction."""
        stride = max(1, len(scan_base) // _SEARCH_POINTS)
        points = scan_base.points[::stride]
        reach = _SEARCH_SIGMAS * np.sqrt(np.diag(prior))
        half_m = float(np.clip(max(reach[0], reach[1]), _SEARCH_STEP_M, self.window_m))
        radius_m = float(np.median(np.linalg.norm(points, axis=1))) + 0.1
        step_rad = _SEARCH_STEP_M / radius_m
        half_rad = float(np.clip(reach[2], step_rad, self.window_rad))
        shifts = _steps(half_m, _SEARCH_STEP_M)
        offsets = np.stack(np.meshgrid(shifts, shifts), axis=-1).reshape(-1, 2)
        turns = _steps(half_rad, step_rad)
        yaws = predicted[2] + turns
        c, s = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x, y = points.T
        rotated = np.stack([c * x - s * y, s * x + c * y], axis=-1) + predicted[:2]
        scores = field.likelihood(rotated, offsets)
        scaled = np.concatenate([offsets / max(reach[0], reach[1]) * _SEARCH_SIGMAS])
        penalty = (
            np.sum(scaled**2, axis=1)[None] + (turns / reach[2] * _SEARCH_SIGMAS)[:, None] ** 2
        )
        best = int(np.argmax(scores - _PRIOR_WEIGHT * penalty))
        turn, offset = divmod(best, len(offsets))
        return np.array([*(predicted[:2] + offsets[offset]), wrap(float(yaws[turn]))])

    def _refine(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        start: Planar,
        predicted: Planar,
        information: Matrix,
        shift_m: float,
    ) -> Match:
        pose = start.copy()
        for kernel_m, iterations in zip(_KERNELS_M, _ITERATIONS, strict=True):
            for _ in range(iterations):
                H, g, _ = self._laser_equations(scan_base, field, pose, kernel_m, shift_m)
                off = pose - predicted
                off[2] = wrap(off[2])
                step = -np.linalg.solve(H + information, g + information @ off)
                pose = pose + step
                pose[2] = wrap(pose[2])
                if np.all(np.abs(step) < _CONVERGED):
                    break
        H, _, weak = self._laser_equations(scan_base, field, pose, _KERNELS_M[-1], shift_m)
        alone = H
        if shift_m != self.shift_m:
            alone, _, _ = self._laser_equations(
                scan_base, field, pose, _KERNELS_M[-1], self.shift_m
            )
        residual, far = _residuals(scan_base, field, pose)
        inlier = residual < _INLIER_M
        count = max(len(scan_base), 1)
        return Match(
            T_local_base=pose,
            information=alone,
            covariance=np.asarray(np.linalg.inv(H + information), dtype=np.float64),
            inliers=int(inlier.sum()),
            inlier_ratio=float(inlier.sum() / count),
            overlap_ratio=float((far < 0.5).sum() / count),
            weak_directions=weak,
        )

    def _laser_equations(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        pose: Planar,
        kernel_m: float,
        shift_m: float,
    ) -> tuple[Matrix, Planar, int]:
        """Return the normal equations H, g in (x, y, yaw), and how many directions are weak."""
        arms = scan_base.points @ rotation(pose[2]).T
        near = field.nearest(arms + pose[:2])
        ex, ey = (arms + pose[:2] - near.points).T
        xx, xy, yy = near.shape.T
        ax, ay = xx * ex + xy * ey, xy * ex + yy * ey  # the error across the surface
        robust = (kernel_m**2 / (kernel_m**2 + ax * ex + ay * ey)) ** 2
        gate = ex * ex + ey * ey < (4.0 * kernel_m) ** 2
        along = (ex - ax) ** 2 + (ey - ay) ** 2  # a surface's end is further away
        gate &= along < np.maximum(_END_M, 2.0 * scan_base.spacing_m) ** 2
        beyond = near.outward[:, 0] * ex + near.outward[:, 1] * ey
        is_dense = scan_base.spacing_m < field.resolution_m  # else cells between beams are empty
        gate &= (beyond < 0.5 * field.resolution_m) | ~is_dense
        weight = scan_base.weight * robust * gate / _CORRELATION
        total = float(weight.sum())
        centre = (weight @ arms) / max(total, 1e-12)
        lx, ly = -(arms[:, 1] - centre[1]), arms[:, 0] - centre[0]  # what a turn moves a point by
        tx, ty = xx * lx + xy * ly, xy * lx + yy * ly
        H = np.empty((3, 3))
        H[0, 0], H[0, 1], H[1, 1] = weight @ xx, weight @ xy, weight @ yy
        H[0, 2], H[1, 2], H[2, 2] = weight @ tx, weight @ ty, weight @ (lx * tx + ly * ty)
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        g = np.array([weight @ ax, weight @ ay, weight @ (lx * ax + ly * ay)])
        spread_m = float(np.sqrt(weight @ (lx * lx + ly * ly) / max(total, 1e-12)))
        spread_m = max(spread_m, 1e-3)
        H, g, weak = self._keep_held(H, g, total, spread_m)
        if shift_m > 0:  # (H^-1 + C)^-1 of what is held, for a common error of covariance C
            C = shift_m**2 * np.diag([1.0, 1.0, spread_m**-2])
            damping = np.linalg.inv(np.eye(3) + H @ C)
            H, g = damping @ H, damping @ g
        # From turning about the points' centre to turning about base.
        M = np.eye(3)
        M[:2, 2] = -centre[1], centre[0]
        return M.T @ H @ M, M.T @ g, weak

    def _keep_held(
        self, H: Matrix, g: Planar, total: float, spread_m: float
    ) -> tuple[Matrix, Planar, int]:
        """Take directions out that fewer than `degeneracy_ratio` of the points hold."""
        if total <= 0:
            return np.zeros((3, 3)), np.zeros(3), 3
        scale = np.array([1.0, 1.0, 1.0 / spread_m])
        values, vectors = np.linalg.eigh(H * np.outer(scale, scale) / total)
        held = values > self.degeneracy_ratio
        keep = vectors[:, held] @ vectors[:, held].T
        inverse = 1.0 / scale
        kept = keep @ (vectors * values) @ vectors.T @ keep
        held_H: Matrix = total * np.outer(inverse, inverse) * kept
        held_g: Planar = np.asarray(inverse * (keep @ (scale * g)), dtype=np.float64)
        return held_H, held_g, int(3 - held.sum())


def novelty(T_before_now: Planar) -> float:
    """Return how much of a scan's error is its own, by the motion since the scan before."""
    moved = np.hypot(*T_before_now[:2]) / _VIEW_M, abs(T_before_now[2]) / _VIEW_RAD
    return float(np.clip(max(moved), _NOVELTY_MIN, 1.0))


def _residuals(
    scan_base: SurfacePoints, field: LikelihoodField, pose: Planar
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the distances [m] to the nearest surface, and to its nearest point."""
    points = scan_base.points @ rotation(pose[2]).T + pose[:2]
    near = field.nearest(points)
    error = points - near.points
    xx, xy, yy = near.shape.T
    across = xx * error[:, 0] ** 2 + 2 * xy * error[:, 0] * error[:, 1] + yy * error[:, 1] ** 2
    far = np.linalg.norm(error, axis=1)
    unknown = xx + yy == 0
    across = np.where(unknown, far, np.sqrt(np.maximum(across, 0.0)))
    return np.where(far < 4 * _INLIER_M, across, far), far


def _steps(half: float, step: float) -> NDArray[np.float64]:
    count = int(np.floor(half / step + 1e-9))
    return np.arange(-count, count + 1).astype(np.float64) * step
