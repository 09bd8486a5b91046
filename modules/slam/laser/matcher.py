"""Scan matching: a correlative search around the prediction, then Gauss-Newton with the prior.

The search (after Olson, "Real-time correlative scan matching", ICRA 2009) finds the basin; the
refinement is point-to-line where the map holds lines, with the prediction as one more measurement.
Directions that the geometry does not constrain are removed from the laser's information (after
Zhang, Kaess, Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016), so
that there the prior alone decides.

Two beams are a surface: along a corridor, the few that see its far end are often all that tells the
motion. The direction of such a surface is uncertain, and with it where the surface is between them.

A scan made from a band of heights does not show exact walls: the nearest object in the band changes
with the viewpoint, for many beams together. Such an error does not average out over beams, nor over
scans taken from almost the same place.

Scan points beyond the end of a mapped surface do not belong to it: such pairs are dropped (after
Turk and Levoy, "Zippered polygon meshes from range images", SIGGRAPH 1994). Otherwise they would
bias a turn: on the side to which the robot turns, the scan always shows more than the map. Nor are
such points evidence against a pose, unless beams passed where they are: otherwise a robot would
seem to stand still, as then there is least that is new.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.motion.trust import NoiseRatio
from sceneslam.types.planar import Matrix, Planar, rotation, wrap

from .field import LikelihoodField
from .prior import MotionPrior, difference, is_apart
from .surface import SurfacePoints

_SEARCH_POINTS = 120  # more do not change the coarse answer
_SEARCH_STEP_M = 0.1
_PRIOR_WEIGHT = 0.02  # mean likelihood of a point that outweighs one nat of the prior
_KERNELS_M = (0.25, 0.12, 0.06)  # of the robust weight: coarse to fine
_ITERATIONS = (3, 3, 8)  # at most, per kernel
_CONVERGED = np.array([3e-4, 3e-4, 1e-4])  # m, m, rad: a step this small is the last
_INLIER_M = 0.1
_END_M = 0.1  # a mapped surface may continue this far, or twice the beams' spacing
_CORRELATION = 4.0  # neighbouring beams have common errors: information is divided by this ...
_APART_M = 0.175  # ... and evidence by the beams in this distance, if fewer: 4 of a degree at 2.5 m
_UNEVEN = 3.0  # by so much scans usually fit better or worse than on average
_SLACK = 2.0  # scans that fit worse by less do not add up
_USUAL_SCANS = 20.0  # over which that average is taken
_VIEW_M, _VIEW_RAD = 0.1, 0.1  # scans this far apart have independent errors
_NOVELTY_MIN = 1e-3
_EYE = np.eye(3)
_NOISE_MIN = 0.1  # least noise of a scan, relative to the expected one: a map has cells


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
    cost: float  # negative logarithm of the evidence of scan and prior, up to a constant
    scan_cost: float  # of that, the scan's
    fit_cost: float  # the same if all beams had errors in common
    noise: float  # deviation of the points from the map, relative to the expected one
    probabilities: NDArray[np.float64]  # of the priors, given the scan

    @property
    def weighs_sources(self) -> bool:
        """Tell whether it compares the sources of motion; a wide search knows none of them."""
        return len(self.probabilities) > 1

    def drawn_to(self, prior: MotionPrior) -> Planar:
        """Return the difference (3,) of the pose that a prior makes, by the scan's shape."""
        H, pose, weight = self.information, self.T_local_base, prior.weighed(self.T_local_base)
        pull = difference(self.T_local_alone, pose)
        step = np.linalg.solve(H + weight, H @ pull - weight @ prior.off(pose))
        return np.asarray(step, np.float64)

    def cost_with(self, prior: MotionPrior) -> float:
        """Return the cost with another prior, by the shape of the scan's cost here.

        Where it leads farther away than that shape is known, the scan says nothing about it.
        """
        H, pose, step = self.information, self.T_local_base, self.drawn_to(prior)
        if is_apart(step):
            return self.cost - float(np.log(prior.probability))
        pull = difference(self.T_local_alone, pose)
        gained = 0.5 * float(pull @ H @ pull - (step - pull) @ H @ (step - pull))
        return self.scan_cost - gained + prior.cost_at(pose + step) - prior.spread_after(H)


@dataclass(slots=True)
class Matcher:
    """Fits scans into a likelihood field."""

    window_m: float
    window_rad: float
    degeneracy_ratio: float
    shift_m: float  # standard deviation of a scan's common error
    misfit: float = 0.0  # by how much the last scans fit worse than those before [nats]
    noise: NoiseRatio = field(default_factory=lambda: NoiseRatio(1.0))  # of points, to the expected
    _usual: float | None = None  # cost of a point of the last scans

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
        shift_m = self.shift_m / float(np.sqrt(novelty))
        count = float((_CORRELATION / _alike(scan_base)).sum())  # as many points of usual evidence
        usual_cost = 0.0 if self._usual is None else self._usual * count
        best = self._refine(scan_base, field, priors[0].pose, priors[0], shift_m)
        costs = np.array([best.cost, *(best.cost_with(prior) for prior in priors[1:])])
        least = min(best.scan_cost, usual_cost - _UNEVEN)
        is_poor = best.cost > usual_cost + _UNEVEN + priors[0].cost_least(best.information)
        H, at = best.information, best.T_local_base
        rivals = [k for k, one in enumerate(priors) if least + one.cost_least(H) < best.cost]
        open_to = [k for k in rivals if is_apart(priors[k].off(at))]
        # From nearly the same pose, a motion that holds the scan less may lead it elsewhere.
        drawn_to = [k for k in rivals if is_poor and is_apart(best.drawn_to(priors[k]))]
        matches = {0: [best]}
        if open_to or is_poor:
            found = self._search(scan_base, field, priors)
            nearest = int(np.argmin([prior.cost_at(found) for prior in priors]))
            tried = sorted({*open_to, *drawn_to} - {0})
            for k, start in [(nearest, found), *((k, priors[k].pose) for k in tried)]:
                match = self._refine(scan_base, field, start, priors[k], shift_m)
                matches.setdefault(k, []).append(match)
        likely, best = min(
            ((k, one) for k, some in matches.items() for one in some), key=lambda each: each[1].cost
        )
        for k, some in matches.items():
            cost = min(one.cost for one in some)
            costs[k] = cost if k in open_to else min(costs[k], cost)
        self._compare(best, len(scan_base))
        weights = np.exp(best.cost - costs)
        noise = max(best.noise, _NOISE_MIN)
        self.noise.learn(noise, 1.0, floor=0.0, variance=0.0, share=1.0)
        # Motions are weighed by the expected noise, as scans differ by more than noise in how they
        # fit: moving things and the map's errors are common to many beams. The pose is by the
        # estimated noise.
        scan_base = scan_base.with_noise(self.noise.ratio)
        best = self._refine(
            scan_base, field, best.T_local_base, priors[likely], shift_m, is_near=True
        )
        return replace(best, probabilities=weights / weights.sum())

    def _compare(self, match: Match, count: int) -> None:
        """Compare how a scan of `count` points fits with the scans before (Page's CUSUM)."""
        each = match.fit_cost / max(count, 1)
        if self._usual is None:
            self._usual = each
        worse = match.fit_cost - self._usual * count - _SLACK
        self.misfit = max(self.misfit + min(worse, _UNEVEN), 0.0)
        self._usual += (each - self._usual) / _USUAL_SCANS

    def refine(
        self, scan_base: SurfacePoints, field: LikelihoodField, start: Planar, prior: MotionPrior
    ) -> Match:
        """Return the pose of a scan, without search, from `start` (3,)."""
        scan_base = scan_base.with_noise(self.noise.ratio)
        return self._refine(scan_base, field, start, prior, self.shift_m)

    def _search(
        self, scan_base: SurfacePoints, field: LikelihoodField, priors: Sequence[MotionPrior]
    ) -> Planar:
        """Return the most likely pose on a grid that covers every source of motion."""
        predicted = priors[0].pose
        stride = max(1, len(scan_base) // _SEARCH_POINTS)
        points = scan_base.points[::stride]
        reach = np.max([prior.reach(predicted) for prior in priors], axis=0)
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
        costs = np.min([prior.costs(predicted, offsets, turns) for prior in priors], axis=0)
        best = int(np.argmax(scores - _PRIOR_WEIGHT * costs))
        turn, offset = divmod(best, len(offsets))
        return np.array([*(predicted[:2] + offsets[offset]), wrap(float(yaws[turn]))])

    def _refine(
        self,
        scan_base: SurfacePoints,
        field: LikelihoodField,
        start: Planar,
        expected: MotionPrior,
        shift_m: float,
        *,
        is_near: bool = False,
    ) -> Match:
        """Return the pose by Gauss-Newton from a start, with one prior; `is_near`: fine alone."""
        pose = start.copy()
        levels = list(zip(_KERNELS_M, _ITERATIONS, strict=True))
        for kernel_m, iterations in levels[-1:] if is_near else levels:
            for _ in range(iterations):
                pairs = _Pairs.of(scan_base, field, pose)
                H, g, _ = self._laser_equations(scan_base, pairs, kernel_m, [shift_m])[0]
                prior = expected.weighed(pose)
                step = -np.linalg.solve(H + prior, g + prior @ expected.off(pose))
                pose = pose + step
                pose[2] = wrap(pose[2])
                if np.all(np.abs(step) < _CONVERGED):
                    break
        pairs = _Pairs.of(scan_base, field, pose)
        (H, _, weak), (alone, _, _) = self._laser_equations(
            scan_base, pairs, _KERNELS_M[-1], [shift_m, self.shift_m]
        )
        residual, far, evident = _residuals(scan_base, field, pairs, pose, self.noise.ratio)
        inlier = residual < _INLIER_M
        count = max(len(scan_base), 1)
        prior, off = expected.weighed(pose), expected.off(pose)
        pull = np.linalg.pinv(H, rcond=1e-9, hermitian=True) @ prior @ off
        costs = _costs(scan_base, evident)
        scan_cost = float((costs / _alike(scan_base)).sum())
        return Match(
            T_local_base=pose,
            information=alone,
            covariance=np.asarray(np.linalg.inv(H + prior), dtype=np.float64),
            inliers=int(inlier.sum()),
            inlier_ratio=float(inlier.sum() / count),
            overlap_ratio=float((far < 0.5).sum() / count),
            weak_directions=weak,
            T_local_alone=pose + pull,
            cost=scan_cost + expected.cost_at(pose) - expected.spread_after(H),
            scan_cost=scan_cost,
            fit_cost=float(costs.sum()) / _CORRELATION,
            noise=_noise(scan_base, evident),
            probabilities=np.ones(1),
        )

    def _laser_equations(
        self,
        scan_base: SurfacePoints,
        pairs: _Pairs,
        kernel_m: float,
        shifts_m: Sequence[float],
    ) -> list[tuple[Matrix, Planar, int]]:
        """Return the normal equations H, g in (x, y, yaw), and the number of weak directions.

        For each of the standard deviations of the scan's common error.
        """
        (x, y), (ex, ey), (ax, ay), (xx, xy, yy) = (
            pairs.arms,
            pairs.error,
            pairs.across,
            pairs.shape,
        )
        robust = (kernel_m**2 / (kernel_m**2 + ax * ex + ay * ey)) ** 2
        gate = ~pairs.is_beyond & (ex * ex + ey * ey < (4.0 * kernel_m) ** 2)
        weight = scan_base.weight * pairs.certain * robust * gate / _CORRELATION
        total = float(weight.sum())
        centre = (pairs.arms @ weight) / max(total, 1e-12)
        lx, ly = centre[1] - y, x - centre[0]  # a point's motion per radian
        tx, ty = xx * lx + xy * ly, xy * lx + yy * ly
        H = np.empty((3, 3))
        H[0, 0], H[0, 1], H[1, 1] = weight @ xx, weight @ xy, weight @ yy
        H[0, 2], H[1, 2], H[2, 2] = weight @ tx, weight @ ty, weight @ (lx * tx + ly * ty)
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        g = np.array([weight @ ax, weight @ ay, weight @ (lx * ax + ly * ay)])
        spread_m = float(np.sqrt(weight @ (lx * lx + ly * ly) / max(total, 1e-12)))
        spread_m = max(spread_m, 1e-3)
        H, g, weak = self._keep_held(H, g, total, spread_m)
        # From turning about the points' centre to turning about base.
        M = _EYE.copy()
        M[:2, 2] = -centre[1], centre[0]
        found = []
        for shift_m in shifts_m:
            # (H^-1 + C)^-1 in constrained directions, for a common error C
            C = shift_m**2 * np.array([1.0, 1.0, spread_m**-2])
            damping = np.linalg.inv(_EYE + H * C)
            found.append((M.T @ (damping @ H) @ M, M.T @ (damping @ g), weak))
        return found

    def _keep_held(
        self, H: Matrix, g: Planar, total: float, spread_m: float
    ) -> tuple[Matrix, Planar, int]:
        """Remove directions that fewer than `degeneracy_ratio` of the points constrain."""
        if total <= 0:
            return np.zeros((3, 3)), np.zeros(3), 3
        scale = np.array([1.0, 1.0, 1.0 / spread_m])
        values, vectors = np.linalg.eigh(H * scale[:, None] * scale / total)
        held = values > self.degeneracy_ratio
        keep = vectors[:, held] @ vectors[:, held].T
        inverse = 1.0 / scale
        kept = keep @ (vectors * values) @ vectors.T @ keep
        held_H: Matrix = total * inverse[:, None] * inverse * kept
        held_g: Planar = np.asarray(inverse * (keep @ (scale * g)), dtype=np.float64)
        return held_H, held_g, int(3 - held.sum())


def novelty(T_before_now: Planar) -> float:
    """Return the independent share of a scan's error, by the motion (3,) since the last scan."""
    moved = np.hypot(*T_before_now[:2]) / _VIEW_M, abs(T_before_now[2]) / _VIEW_RAD
    return float(np.clip(max(moved), _NOVELTY_MIN, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pairs:
    """A scan's points, each with the nearest surface of the map, component by component."""

    arms: NDArray[np.float64]  # (2, N) [m], from the base, axes of local
    error: NDArray[np.float64]  # (2, N) [m], from the surface
    across: NDArray[np.float64]  # (2, N) [m], of that, across the surface
    shape: NDArray[np.float64]  # (3, N)
    certain: NDArray[np.float64]  # (N,), share of the variance that is not the normal's
    is_beyond: NDArray[np.bool_]  # (N,), the surface has ended before
    is_sparse: NDArray[np.bool_]  # (N,), its direction is uncertain between the beams

    @classmethod
    def of(cls, scan_base: SurfacePoints, field: LikelihoodField, pose: Planar) -> _Pairs:
        """Return the pairs of a scan at a pose."""
        arms = rotation(pose[2]) @ scan_base.points.T
        points = arms + pose[:2, None]
        near = field.nearest(points)
        error, (xx, xy, yy) = points - near.points, near.shape
        ex, ey = error
        across = np.array([xx * ex + xy * ey, xy * ex + yy * ey])
        rest = error - across
        along = rest[0] ** 2 + rest[1] ** 2  # a surface's end is farther away
        beyond = near.outward[0] * ex + near.outward[1] * ey
        is_dense = scan_base.spacing_m < field.resolution_m  # else cells between beams are empty
        # A surface's noise is that of the scan: both are expected, or both are estimated.
        turn = near.normal_variance * scan_base.weight * scan_base.noise_ratio**2  # [1/m^2]
        return cls(
            arms=arms,
            error=error,
            across=across,
            shape=near.shape,
            certain=1.0 / (1.0 + turn * along),
            is_sparse=turn * (2.0 * scan_base.spacing_m) ** 2 > 1.0,
            is_beyond=(along >= np.maximum(_END_M, 2.0 * scan_base.spacing_m) ** 2)
            | ((beyond >= 0.5 * field.resolution_m) & is_dense),
        )


def _residuals(
    scan_base: SurfacePoints, field: LikelihoodField, pairs: _Pairs, pose: Planar, noise: float
) -> tuple[Planar, Planar, Planar]:
    """Return the points' distances [m] as inliers, to the nearest point, and as evidence.

    Inliers: to the nearest surface, or to its point if its direction is uncertain: with sparse
    beams, a surface is near only by chance. Evidence: to the surface; a point without one, in space
    that nothing saw before, is as likely as one at its surface, by the `noise` relative to the
    expected one.
    """
    across = np.sqrt(np.maximum((pairs.across * pairs.error).sum(axis=0), 0.0))
    far = np.hypot(*pairs.error)
    unknown = pairs.shape[0] + pairs.shape[2] == 0
    is_near = far < 4 * _INLIER_M
    is_alone = ~is_near & (far >= 2.0 * scan_base.spacing_m) | pairs.is_beyond
    evident = np.where(unknown, 0.0, across * np.sqrt(pairs.certain))
    alone = np.flatnonzero(is_alone & ~unknown)
    is_free = field.is_free(pairs.arms[:, alone].T + pose[:2])
    evident[alone] = np.where(is_free, far[alone], noise / np.sqrt(scan_base.weight[alone]))
    return np.where(is_near & ~unknown & ~pairs.is_sparse, across, far), far, evident


def _costs(scan_base: SurfacePoints, residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the negative log-likelihood of each point alone (N,), which is bounded."""
    squared, limit = residual**2, _KERNELS_M[-1] ** 2
    return np.asarray(0.5 * scan_base.weight * limit * squared / (limit + squared))


def _alike(scan_base: SurfacePoints) -> NDArray[np.float64]:
    """Return how many beams (N,) have errors in common with a beam.

    Beams that are far apart have their own: few of them see the far end of a corridor.
    """
    return np.clip(_APART_M / scan_base.spacing_m, 1.0, _CORRELATION)


def _noise(scan_base: SurfacePoints, residual: NDArray[np.float64]) -> float:
    """Return the points' deviation from the map, relative to the expected one, without outliers."""
    squared, limit = residual**2, _KERNELS_M[-1] ** 2
    robust = np.where(squared > 0.0, (limit / (limit + squared)) ** 2, 0.0)  # 0: no surface
    return float(np.sqrt(robust @ (scan_base.weight * squared) / max(robust.sum(), 1e-12)))


def _steps(half: float, step: float) -> NDArray[np.float64]:
    count = int(np.floor(half / step + 1e-9))
    return np.arange(-count, count + 1).astype(np.float64) * step
