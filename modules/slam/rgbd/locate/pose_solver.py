"""The camera's pose from matched landmarks: Gauss-Newton, and PnP without a prediction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .pose_errors import PoseErrors
from .residuals import CHI2_PIXEL, Sightings

_RANSAC_PX = 8.0  # error of rows while a camera begins to turn (rolling shutter)
_RANSAC_TRIALS = 200
_RANSAC_CONFIDENCE = 0.999
_APPROACH_STEPS, _REFINEMENT_STEPS = 2, 5
_SMALL_STEP = 0.3  # [sigma], size of the last step; a third of it remains
MIN_INLIER_RATIO = 0.4  # least share of inliers among the matches at a correct pose
# What moves was found in few images where it is now; swept in experiments/moving_things.md.
_PROVEN_IMAGES = (3, 10)  # a landmark is proven if found in 3, where many were in more of them
_PROVEN = 100  # landmarks, which are many
_MAX_CONDITION = 1e12  # of the normal matrix; beyond, some motion is not observable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurements:
    """Landmarks with their measurements in the image."""

    points_local: NDArray[np.float64]  # (N, 3) [m]
    seen: Sightings  # (N,)
    images: NDArray[np.int64]  # (N,), in which they were found

    @property
    def proven(self) -> NDArray[np.bool_]:
        """Return (N,) True for those found in most images: they stand still."""
        low, high = _PROVEN_IMAGES
        if len(self.images) > _PROVEN:
            most = int(-np.partition(-self.images, _PROVEN)[_PROVEN])
            low = min(max(low, most), high)
        return np.asarray(self.images >= low)

    def take(self, rows: NDArray[np.int64]) -> Measurements:
        """Return the rows (M,) alone."""
        return Measurements(
            points_local=self.points_local.take(rows, axis=0),
            seen=self.seen.take(rows),
            images=self.images.take(rows),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What other sensors tell of a pose."""

    T_local_base: Transform
    information: NDArray[np.float64]  # (6, 6), se3.log order, base frame

    def off(self, T_local_base: Transform) -> NDArray[np.float64]:
        """Return by which twist (6,) a pose (4, 4) differs."""
        return se3.log(se3.inverse(self.T_local_base) @ T_local_base)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consensus:
    """A rough pose and the measurements that agree with it."""

    T_local_base: Transform
    inlier_rows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """The inlier pixels of a pose, with the linearised equations."""

    residuals: NDArray[np.float64]  # (2 N,) in sigmas, all u before all v
    jacobian: NDArray[np.float64]  # (6, 2 N), by a twist of the camera
    sigma_px: NDArray[np.float64]  # (N,)
    normal: NDArray[np.float64]  # (6, 6), of a twist of the camera, depths included

    @property
    def pixel_variance(self) -> float:
        """Return the variance of the residuals [sigma^2], given that the pose took six of them."""
        return float(self.residuals @ self.residuals) / (len(self.residuals) - 6)

    def follow(self, moved: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the camera's twist (6,) if the pixels move by `moved` (2 N,) sigmas."""
        return np.asarray(np.linalg.solve(self.normal, self.jacobian @ moved))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseEstimate:
    """A pose with its covariance and the measurements that agree with it."""

    T_local_base: Transform
    covariance: NDArray[np.float64]  # (6, 6), se3.log order, base frame
    prior: NDArray[np.float64]  # (6, 6), other sensors' share of its inverse; zero without any
    inliers: NDArray[np.bool_]  # (N,), pixels agree
    depth_inliers: NDArray[np.bool_]  # (N,), depths agree too
    depth_agreement_ratio: float  # of the inliers that have a depth; 1 without any
    linearised: Linearised  # of the inliers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Descent:
    """The result of Gauss-Newton, with its inliers."""

    T_local_cam: Transform
    errors: PoseErrors
    normal: NDArray[np.float64]  # (6, 6), of the last step's twist of the camera, without a prior
    inliers: NDArray[np.bool_]  # (N,), pixels agree
    depth_inliers: NDArray[np.bool_]  # (N,), depths agree too

    def agreeing(self, used: NDArray[np.bool_], known: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (N,) where the pixel is within its 95 % limit, given how sure the pose is.

        That is by the landmarks that were `used` (N,), and a prior's normal matrix (6, 6).
        """
        residuals = self.errors.residuals[:2]
        squares = (residuals**2).sum(axis=0)
        by_used = squares[self.inliers & used]
        variance = max(1.0, by_used.sum() / max(1, 2 * len(by_used) - 6))
        slopes = self.errors.rows(np.ones((3, 1)))[:6, :2]  # (6, 2, N)
        covariance = np.linalg.inv(self.normal / variance + known)
        spread = np.einsum("ian,ij,jan->n", slopes, covariance, slopes)
        return np.asarray(squares <= CHI2_PIXEL * (1.0 + spread))


class PoseSolver:
    """Finds T_local_base; deterministic for a seed."""

    def __init__(self, camera: Camera, *, seed: int, min_inliers: int = 20) -> None:
        """Build; `min_inliers` proven landmarks give a pose on their own."""
        self._camera, self._seed, self._min_inliers = camera, seed, min_inliers
        self._T_cam_base = se3.inverse(camera.T_base_cam)
        self._to_base = se3.adjoint(camera.T_base_cam)

    def search(self, measured: Measurements) -> Consensus | None:
        """Return the pose that most pixels of proven landmarks agree with, None if not found.

        That of all landmarks where many more agree with it; what was found once has no vote.
        """
        among_all = self._consensus(measured)
        rows = np.flatnonzero(measured.proven)
        if among_all is None or not self._min_inliers <= len(rows) < len(measured.images):
            return among_all
        found = self._consensus(measured.take(rows))
        votes = np.count_nonzero(measured.images[among_all.inlier_rows] > 1)
        least = max(self._min_inliers, MIN_INLIER_RATIO * votes)
        if found is None or len(found.inlier_rows) < least:
            return among_all
        return replace(found, inlier_rows=rows.take(found.inlier_rows))

    def _consensus(self, measured: Measurements) -> Consensus | None:
        """Return the pose that most pixels agree with (AP3P, RANSAC), None if not found."""
        if len(measured.points_local) < 4:
            return None
        cv2.setRNGSeed(self._seed)
        found, rotvec, translation, inlier_rows = cv2.solvePnPRansac(
            measured.points_local,
            measured.seen.uv_px,
            self._camera.K,
            None,
            iterationsCount=_RANSAC_TRIALS,
            reprojectionError=_RANSAC_PX,
            confidence=_RANSAC_CONFIDENCE,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not found or not (np.isfinite(rotvec).all() and np.isfinite(translation).all()):
            return None
        rotation = se3.so3_exp(rotvec.ravel().astype(np.float64))
        T_cam_local = se3.from_parts(rotation, translation.ravel().astype(np.float64))
        return Consensus(
            T_local_base=se3.inverse(T_cam_local) @ self._T_cam_base,
            inlier_rows=inlier_rows.ravel().astype(np.int64),
        )

    def approach(self, measured: Measurements, T_local_base: Transform) -> Consensus | None:
        """Return a rough pose near a predicted one (4, 4), None if the pixels disagree."""
        end = self._descend(measured, T_local_base, _APPROACH_STEPS)
        if end is None:
            return None
        return Consensus(
            T_local_base=end.T_local_cam @ self._T_cam_base,
            inlier_rows=np.flatnonzero(end.inliers),
        )

    def refine(
        self, measured: Measurements, T_local_base: Transform, prior: Prior | None = None
    ) -> PoseEstimate | None:
        """Return the pose that minimises pixel and inverse-depth errors, None if that fails.

        Those of the `prior`, if there is one, count as well. The covariance is of a twist of the
        base, T_local_base @ exp(xi). Residuals as in stereo bundle adjustment: a depth camera's
        disparity error is constant, so its depth error grows with the square.
        """
        end = self._descend(measured, T_local_base, _REFINEMENT_STEPS, prior)
        if end is None:
            return None
        inliers, residuals = end.inliers, end.errors.residuals[:2, end.inliers].ravel()
        slopes = end.errors.rows(np.ones((3, 1)))[:6]
        by_pixel = slopes[:, :2, inliers].reshape(6, -1)
        by_depth = slopes[:, 2, end.depth_inliers]
        linearised = Linearised(
            residuals=residuals,
            jacobian=by_pixel,
            sigma_px=measured.seen.sigma_px[inliers],
            normal=by_pixel @ by_pixel.T + by_depth @ by_depth.T,
        )
        # If the errors are larger than their sigmas, the image tells that much less.
        information = end.normal / max(1.0, linearised.pixel_variance) + self._known(prior)
        covariance = se3.carried(np.linalg.inv(information), self._camera.T_base_cam)
        return PoseEstimate(
            T_local_base=se3.orthonormal(end.T_local_cam @ self._T_cam_base),
            covariance=0.5 * (covariance + covariance.T),
            prior=np.zeros((6, 6)) if prior is None else prior.information,
            inliers=inliers,
            depth_inliers=end.depth_inliers,
            depth_agreement_ratio=_share(end.depth_inliers, inliers & measured.seen.measures_depth),
            linearised=linearised,
        )

    def _descend(
        self,
        measured: Measurements,
        T_local_base: Transform,
        steps: int,
        prior: Prior | None = None,
    ) -> _Descent | None:
        """Return the result of Gauss-Newton by what agrees with the proven landmarks.

        A thing that moves through the image may have more landmarks than the room. All count where
        proven landmarks do not agree on a pose, or most others contradict it.
        """
        T_cam_local = se3.inverse(T_local_base @ self._camera.T_base_cam)
        errors = PoseErrors(self._camera, measured.points_local, measured.seen)
        settle = partial(self._settle, errors, measured.seen.measures_depth, steps, prior)
        proven = measured.proven
        if self._min_inliers <= np.count_nonzero(proven) < len(proven):
            end = settle(T_cam_local, proven)
            agreed = 0 if end is None else np.count_nonzero(end.inliers & proven)
            if end is not None and agreed >= max(self._min_inliers, 0.5 * np.count_nonzero(proven)):
                usable = end.agreeing(proven, self._known(prior))
                end = settle(se3.inverse(end.T_local_cam), usable)
                if end is not None and end.inliers[measured.images > 1].mean() >= MIN_INLIER_RATIO:
                    return end
        return settle(T_cam_local, np.ones(len(proven), bool))

    def _settle(
        self,
        errors: PoseErrors,
        measures_depth: NDArray[np.bool_],
        steps: int,
        prior: Prior | None,
        T_cam_local: Transform,
        usable: NDArray[np.bool_],
    ) -> _Descent | None:
        """Return the pose by the usable landmarks (N,), less the outliers after every step.

        All landmarks that agree with it are its inliers.
        """
        errors.move(T_cam_local)
        inliers, depth_inliers = usable, usable & measures_depth
        for _ in range(steps):
            scale = errors.scale(inliers & usable, depth_inliers & usable)
            rows = errors.rows(scale).reshape(7, -1)
            products = rows @ rows.T
            normal, slopes = products[:6, :6], products[:6, 6]
            if prior is not None:
                off = prior.off(se3.inverse(T_cam_local) @ self._T_cam_base)
                slopes = slopes + self._to_base.T @ prior.information @ off
            step = _solve(normal + self._known(prior), slopes)
            if step is None:
                return None
            T_cam_local = se3.exp(step) @ T_cam_local
            errors.move(T_cam_local)
            inliers = errors.pixels_agree()
            depth_inliers = inliers & measures_depth & errors.depths_agree()
            if np.count_nonzero(inliers & usable) < 4:
                return None
            if step @ slopes < _SMALL_STEP**2:
                break
        return _Descent(
            T_local_cam=se3.inverse(T_cam_local),
            errors=errors,
            normal=normal,
            inliers=inliers,
            depth_inliers=depth_inliers,
        )

    def _known(self, prior: Prior | None) -> NDArray[np.float64]:
        """Return a prior's normal matrix (6, 6) of a twist of the camera."""
        if prior is None:
            return np.zeros((6, 6))
        return np.asarray(self._to_base.T @ prior.information @ self._to_base)


def _solve(normal: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the twist (6,) that solves the normal equations, None if they are singular."""
    if not np.isfinite(normal).all():
        return None
    squares, axes = np.linalg.eigh(normal)
    if squares[0] * _MAX_CONDITION < squares[-1]:
        return None
    return np.asarray((axes / squares) @ (axes.T @ slopes))


def _share(chosen: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(chosen.sum() / of.sum()) if of.any() else 1.0
