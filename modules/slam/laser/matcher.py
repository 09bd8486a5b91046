"""Scan matching: a correlative search around the prediction, then Gauss-Newton with the prior.

The search (after Olson, "Real-time correlative scan matching", ICRA 2009) finds the basin; the
refinement is point-to-line where the map holds lines, with the prediction as one more measurement.
Directions that the geometry does not constrain are removed from the laser's information (after
Zhang, Kaess, Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016), so
that there the prior alone decides.

A scan made from a band of heights does not show exact walls: the nearest object in the band changes
with the viewpoint, for many beams together. Such an error does not average out over beams, nor over
scans taken from almost the same place.

Scan points beyond the end of a mapped surface do not belong to it: such pairs are dropped (after
Turk and Levoy, "Zippered polygon meshes from range images", SIGGRAPH 1994). Otherwise they would
bias a turn: on the side to which the robot turns, the scan always shows more than the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.planar import Matrix, Planar, rotation, wrap

from .field import LikelihoodField
from .surface import SurfacePoints

_SEARCH_POINTS = 120  # more do not change the coarse answer
_SEARCH_STEP_M = 0.1
_SEARCH_SIGMAS = (
    10.0  # beyond, there is less than a thousandth of the prior, heavy as its tails are
)
_PRIOR_WEIGHT = 0.02  # mean likelihood of a point that outweighs one nat of the prior
_KERNELS_M = (0.25, 0.12, 0.06)  # of the robust weight: coarse to fine
_ITERATIONS = (3, 3, 8)  # at most, per kernel
_CONVERGED = np.array([3e-4, 3e-4, 1e-4])  # m, m, rad: a step this small is the last
_INLIER_M = 0.1
_END_M = 0.1  # a mapped surface may continue this far, or twice the beams' spacing
_CORRELATION = 4.0  # neighbouring beams have common errors: information is divided by this
_STUDENT = 4.0  # degrees of freedom of the prior: an error of 10 sigmas has weight 1/20
_NORMAL = 1e6  # degrees of freedom of a normal distribution
_APART_M, _APART_RAD = 0.06, 0.02  # nearer starts converge to the same pose
_VIEW_M, _VIEW_RAD = 0.1, 0.1  # scans this far apart have independent errors
_NOVELTY_MIN = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Match:
    """A scan's pose in the local map."""

    T_local_base: Planar
    information: Matrix  # of the laser alone, without correlation to earlier scans; axes of local
    covariance: Matrix  # of the pose: laser and prior together, axes of local
    inliers: int
    inlier_ratio: float
    overlap_ratio: float  # share of points near a mapped surface
    weak_directions: int  # 0 to 3: unconstrained by the geometry
    T_local_alone: Planar  # by the laser alone, except for weak directions
    cost: float  # negative log-likelihood of scan and pose, up to a constant


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionPrior:
    """The predicted pose of a scan by one source of motion.

    The wheels' prior has heavy tails (Student's distribution), so that a contradicting scan
    prevails. Position and heading are weighted separately: slipping wheels may turn correctly.
    """

    pose: Planar
    covariance: Matrix
    information: Matrix
    cost: float  # negative logarithm of the prior's probability and of its density's peak
    freedom: float  # degrees of freedom of Student's distribution

    @classmethod
    def of(cls, pose: Planar, covariance: Matrix, probability: float = 1.0) -> MotionPrior:
        """Return the prior of a pose (3,) with covariance (3, 3); normal if it is the only one."""
        information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        spread = 0.5 * float(np.linalg.slogdet(covariance)[1])
        return cls(
            pose=pose,
            covariance=covariance,
            information=information,
            cost=spread - float(np.log(probability)),
            freedom=_NORMAL if probability == 1.0 else _STUDENT,
        )

    def off(self, pose: Planar) -> Planar:
        """Return the difference (3,) of a pose from this prior."""
        off = pose - self.pose
        off[2] = wrap(float(off[2]))
        return off

    def weighed(self, pose: Planar) -> Matrix:
        """Return the prior's information (3, 3) at a pose, reduced by the heavy tails."""
        squared = self._squared(pose)
        weight = [min((self.freedom + n) / (self.freedom + squared[n]), 1.0) for n in (2, 1)]
        root = np.sqrt([weight[0], weight[0], weight[1]])
        return np.asarray(self.information * np.outer(root, root))

    def cost_at(self, pose: Planar) -> float:
        """Return the negative log-likelihood of a pose (3,), up to a constant."""
        return self.cost + sum(
            float(_tail(each, n, self.freedom)) for n, each in self._squared(pose).items()
        )

    def is_apart(self, pose: Planar) -> bool:
        """Tell whether a refinement from here may converge differently than from `pose` (3,)."""
        off = np.abs(self.off(pose))
        return bool(max(off[0], off[1]) > _APART_M or off[2] > _APART_RAD)

    def _squared(self, pose: Planar) -> dict[int, float]:
        """Return the squared normalised deviations of position and heading by number of axes."""
        off, information = self.off(pose), self.information
        position = float(off[:2] @ information[:2, :2] @ off[:2])
        return {2: position, 1: float(off[2] ** 2 * information[2, 2])}


@dataclass(slots=True)
class Matcher:
    """Fits scans into a likelihood field."""

    window_m: float
    window_rad: float
    degeneracy_ratio: float
    shift_m: float  # standard deviation of a scan's common error

    def match(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        priors: Sequence[MotionPrior],
        *,
        novelty: float = 1.0,
    ) -> Match:
        """Return the most likely pose of a scan, near the first prior or another one.

        `novelty` (0 to 1): the share of the scan's error that is independent of the scan before;
        1 if the prediction is not measured.
        """
        first = priors[0]
        starts = [first.pose, self._search(scan_base, field, first)]
        starts += [other.pose for other in priors[1:] if other.is_apart(first.pose)]
        if np.array_equal(starts[0], starts[1]):
            del starts[1]
        shift_m = self.shift_m / float(np.sqrt(novelty))
        refined = [self._refine(scan_base, field, start, priors, shift_m) for start in starts]
        return min(refined, key=lambda match: match.cost)

    def refine(
        self, scan_base: SurfacePoints, field: LikelihoodField, start: Planar, prior: Matrix
    ) -> Match:
        """Return the pose of a scan, without search, from `start` (3,) with covariance (3, 3)."""
        return self._refine(scan_base, field, start, [MotionPrior.of(start, prior)], self.shift_m)

    def _search(
        self, scan_base: SurfacePoints, field: LikelihoodField, prior: MotionPrior
    ) -> Planar:
        """Return the most likely pose on a grid around the prediction."""
        predicted, sigma = prior.pose, np.sqrt(np.diag(prior.covariance))
        stride = max(1, len(scan_base) // _SEARCH_POINTS)
        points = scan_base.points[::stride]
        reach = _SEARCH_SIGMAS * sigma
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
        near = np.sum(offsets**2, axis=1) / max(sigma[0], sigma[1]) ** 2
        penalty = _tail(near, 2, prior.freedom)[None]
        penalty = penalty + _tail((turns / sigma[2]) ** 2, 1, prior.freedom)[:, None]
        best = int(np.argmax(scores - _PRIOR_WEIGHT * penalty))
        turn, offset = divmod(best, len(offsets))
        return np.array([*(predicted[:2] + offsets[offset]), wrap(float(yaws[turn]))])

    def _refine(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        start: Planar,
        priors: Sequence[MotionPrior],
        shift_m: float,
    ) -> Match:
        """Return the pose by Gauss-Newton from a start, with its most likely prior."""
        expected = min(priors, key=lambda prior: prior.cost_at(start))
        pose = start.copy()
        for kernel_m, iterations in zip(_KERNELS_M, _ITERATIONS, strict=True):
            for _ in range(iterations):
                H, g, _ = self._laser_equations(scan_base, field, pose, kernel_m, shift_m)
                prior = expected.weighed(pose)
                step = -np.linalg.solve(H + prior, g + prior @ expected.off(pose))
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
        residual, far, evident = _residuals(scan_base, field, pose)
        inlier = residual < _INLIER_M
        count = max(len(scan_base), 1)
        prior, off = expected.weighed(pose), expected.off(pose)
        return Match(
            T_local_base=pose,
            information=alone,
            covariance=np.asarray(np.linalg.inv(H + prior), dtype=np.float64),
            inliers=int(inlier.sum()),
            inlier_ratio=float(inlier.sum() / count),
            overlap_ratio=float((far < 0.5).sum() / count),
            weak_directions=weak,
            T_local_alone=pose + np.linalg.pinv(H, rcond=1e-9, hermitian=True) @ prior @ off,
            cost=_scan_cost(scan_base, evident) + expected.cost_at(pose),
        )

    def _laser_equations(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        pose: Planar,
        kernel_m: float,
        shift_m: float,
    ) -> tuple[Matrix, Planar, int]:
        """Return the normal equations H, g in (x, y, yaw), and the number of weak directions."""
        arms = scan_base.points @ rotation(pose[2]).T
        near = field.nearest(arms + pose[:2])
        ex, ey = (arms + pose[:2] - near.points).T
        xx, xy, yy = near.shape.T
        ax, ay = xx * ex + xy * ey, xy * ex + yy * ey  # the error across the surface
        robust = (kernel_m**2 / (kernel_m**2 + ax * ex + ay * ey)) ** 2
        gate = ex * ex + ey * ey < (4.0 * kernel_m) ** 2
        along = (ex - ax) ** 2 + (ey - ay) ** 2  # a surface's end is farther away
        gate &= along < np.maximum(_END_M, 2.0 * scan_base.spacing_m) ** 2
        beyond = near.outward[:, 0] * ex + near.outward[:, 1] * ey
        is_dense = scan_base.spacing_m < field.resolution_m  # else cells between beams are empty
        gate &= (beyond < 0.5 * field.resolution_m) | ~is_dense
        weight = scan_base.weight * robust * gate / _CORRELATION
        total = float(weight.sum())
        centre = (weight @ arms) / max(total, 1e-12)
        lx, ly = -(arms[:, 1] - centre[1]), arms[:, 0] - centre[0]  # a point's motion per radian
        tx, ty = xx * lx + xy * ly, xy * lx + yy * ly
        H = np.empty((3, 3))
        H[0, 0], H[0, 1], H[1, 1] = weight @ xx, weight @ xy, weight @ yy
        H[0, 2], H[1, 2], H[2, 2] = weight @ tx, weight @ ty, weight @ (lx * tx + ly * ty)
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        g = np.array([weight @ ax, weight @ ay, weight @ (lx * ax + ly * ay)])
        spread_m = float(np.sqrt(weight @ (lx * lx + ly * ly) / max(total, 1e-12)))
        spread_m = max(spread_m, 1e-3)
        H, g, weak = self._keep_held(H, g, total, spread_m)
        if shift_m > 0:  # (H^-1 + C)^-1 in constrained directions, for a common error C
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
        """Remove directions that fewer than `degeneracy_ratio` of the points constrain."""
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
    """Return the independent share of a scan's error, by the motion (3,) since the last scan."""
    moved = np.hypot(*T_before_now[:2]) / _VIEW_M, abs(T_before_now[2]) / _VIEW_RAD
    return float(np.clip(max(moved), _NOVELTY_MIN, 1.0))


def _residuals(
    scan_base: SurfacePoints, field: LikelihoodField, pose: Planar
) -> tuple[Planar, Planar, Planar]:
    """Return the points' distances [m] to the nearest surface, to its nearest point, and the first
    again only for points that are evidence: with sparse beams, a surface is near only by chance.
    """
    points = scan_base.points @ rotation(pose[2]).T + pose[:2]
    near = field.nearest(points)
    error = points - near.points
    xx, xy, yy = near.shape.T
    across = xx * error[:, 0] ** 2 + 2 * xy * error[:, 0] * error[:, 1] + yy * error[:, 1] ** 2
    across = np.sqrt(np.maximum(across, 0.0))
    far = np.linalg.norm(error, axis=1)
    unknown = xx + yy == 0
    is_near = far < 4 * _INLIER_M
    evident = np.where(is_near | (far < 2.0 * scan_base.spacing_m), across, far)
    return np.where(is_near & ~unknown, across, far), far, np.where(unknown, 0.0, evident)


def _tail(squared: NDArray[np.float64] | float, size: int, freedom: float) -> NDArray[np.float64]:
    """Return the negative log-density of Student's distribution at squared deviations."""
    return np.asarray(0.5 * (freedom + size) * np.log1p(squared / freedom))


def _scan_cost(scan_base: SurfacePoints, residual: NDArray[np.float64]) -> float:
    """Return the negative log-likelihood of the points, with a bounded cost per point."""
    squared, limit = residual**2, _KERNELS_M[-1] ** 2
    each = 0.5 * scan_base.weight * limit * squared / (limit + squared)
    return float(each.sum()) / _CORRELATION


def _steps(half: float, step: float) -> NDArray[np.float64]:
    count = int(np.floor(half / step + 1e-9))
    return np.arange(-count, count + 1).astype(np.float64) * step
