"""The camera's pose from matched landmarks: PnP against outliers, then Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .residuals import Errors, Sightings, errors

_RANSAC_PX = 4.0
_RANSAC_TRIALS = 200
_RANSAC_CONFIDENCE = 0.999
_ROUNDS = (4, 3, 2)  # Gauss-Newton steps between two looks at who is an outlier
_SMALL_STEP = 1e-4  # [m] and [rad]
_MAX_CONDITION = 1e12  # of the normal matrix; beyond, some motion is not measured at all


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurements:
    """Landmarks and where the image shows them."""

    points_local: NDArray[np.float64]  # (N, 3) [m]
    seen: Sightings  # (N,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consensus:
    """A rough pose and the measurements that agree with it."""

    T_local_base: Transform
    inlier_rows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Linearised:
    """The pixels that agree with a pose, and what moves they would follow."""

    residuals: NDArray[np.float64]  # (2 N,) in sigmas, all u before all v
    jacobian: NDArray[np.float64]  # (6, 2 N), by a twist of the base
    sigma_px: NDArray[np.float64]  # (N,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseEstimate:
    """A pose with its covariance and the measurements that agree with it."""

    T_local_base: Transform
    covariance: NDArray[np.float64]  # (6, 6), se3.log order, base frame
    inliers: NDArray[np.bool_]  # (N,), pixels agree
    depth_inliers: NDArray[np.bool_]  # (N,), depths agree too
    depth_agreement_ratio: float  # of the inliers that have a depth; 1 where none has
    linearised: Linearised  # of the inliers


class PoseSolver:
    """Finds T_local_base; deterministic for a seed."""

    def __init__(self, camera: Camera, *, seed: int) -> None:
        self._camera, self._seed = camera, seed
        self._T_cam_base = se3.inverse(camera.T_base_cam)

    def search(self, measured: Measurements) -> Consensus | None:
        """Return the pose that most pixels agree with (AP3P, RANSAC), None where none is found."""
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

    def refine(self, measured: Measurements, T_local_base: Transform) -> PoseEstimate | None:
        """Return the pose that minimises pixel and inverse-depth errors, None if it has none.

        The motion is a twist of the base, T_local_base @ exp(xi), so that the inverse of the
        normal matrix is the covariance in base. Residuals as in stereo bundle adjustment: a
        depth camera's disparity error is constant, so its depth error grows with the square.
        """
        measures_depth = measured.seen.measures_depth
        inliers, depth_inliers = np.ones(len(measures_depth), bool), measures_depth
        for steps in _ROUNDS:
            for _ in range(steps):
                found, jacobian = self._linearise(measured, T_local_base)
                weights = found.huber_weights() * np.stack([inliers, inliers, depth_inliers])
                weighted = (jacobian * weights).reshape(6, -1)
                normal = np.einsum("ia,ja->ij", weighted, jacobian.reshape(6, -1))
                if not np.isfinite(normal).all() or np.linalg.cond(normal) > _MAX_CONDITION:
                    return None
                step = -np.linalg.solve(normal, weighted @ found.of.ravel())
                T_local_base = T_local_base @ se3.exp(step)
                if np.abs(step).max() < _SMALL_STEP:
                    break
            found, jacobian = self._linearise(measured, T_local_base)
            inliers = found.pixels_agree()
            depth_inliers = inliers & measures_depth & found.depths_agree()
            if inliers.sum() < 4:
                return None
        # Where the errors are larger than their sigmas say, so is the covariance.
        pixel_variance = float((found.of[:2, inliers] ** 2).sum() / (2 * inliers.sum() - 6))
        covariance = np.linalg.inv(normal) * max(1.0, pixel_variance)
        return PoseEstimate(
            T_local_base=_orthonormal(T_local_base),
            covariance=0.5 * (covariance + covariance.T),
            inliers=inliers,
            depth_inliers=depth_inliers,
            depth_agreement_ratio=_share(depth_inliers, inliers & measures_depth),
            linearised=Linearised(
                residuals=found.of[:2, inliers].ravel(),
                jacobian=jacobian[:, :2, inliers].reshape(6, -1),
                sigma_px=measured.seen.sigma_px[inliers],
            ),
        )

    def _linearise(
        self, measured: Measurements, T_local_base: Transform
    ) -> tuple[Errors, NDArray[np.float64]]:
        """Return the errors, and their Jacobian (6, 3, N) by a twist of the base."""
        points_base = se3.apply(se3.inverse(T_local_base), measured.points_local)
        points_cam = np.asarray(se3.apply(self._T_cam_base, points_base), np.float64)
        found = errors(self._camera, points_cam, measured.seen)
        jacobian = np.empty((6, 3, len(points_cam)))
        jacobian[:3] = -np.einsum("kjn,ji->ikn", found.by_point, self._T_cam_base[:3, :3])
        p, move = points_base.T, jacobian[:3]
        # A turn phi of the base moves the point by points_base x phi.
        jacobian[3] = p[1] * move[2] - p[2] * move[1]
        jacobian[4] = p[2] * move[0] - p[0] * move[2]
        jacobian[5] = p[0] * move[1] - p[1] * move[0]
        return found, jacobian


def _share(chosen: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(chosen.sum() / of.sum()) if of.any() else 1.0


def _orthonormal(T_a_b: Transform) -> Transform:
    """Return the transform without the rounding that many products leave in its rotation."""
    return se3.from_quat_xyzw(T_a_b[:3, 3], se3.to_quat_xyzw(T_a_b))
