"""The camera's pose from matched landmarks: PnP against outliers, then Gauss-Newton."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_RANSAC_PX = 4.0
_RANSAC_TRIALS = 200
_RANSAC_CONFIDENCE = 0.999
_CHI2_PIXEL = 5.99  # 95 % of two degrees of freedom
_CHI2_DEPTH = 3.84  # 95 % of one
_HUBER = 2.0  # [sigma]
_MIN_DEPTH_M = 0.05
_ROUNDS = (4, 3, 2)  # Gauss-Newton steps between two looks at who is an outlier
_SMALL_STEP = 1e-5  # [m] and [rad]
_MAX_CONDITION = 1e12  # of the normal matrix; beyond, some motion is not measured at all


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurements:
    """Landmarks and where the image shows them."""

    points_local: NDArray[np.float64]  # (N, 3) [m]
    uv_px: NDArray[np.float64]  # (N, 2), without distortion
    sigma_px: NDArray[np.float64]  # (N,)
    depth_m: NDArray[np.float64]  # (N,), 0 = missing
    inverse_depth_sigma_per_m: NDArray[np.float64]  # (N,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consensus:
    """A rough pose and the measurements that agree with it."""

    T_local_base: Transform
    inlier_rows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseEstimate:
    """A pose with its covariance and the measurements that agree with it."""

    T_local_base: Transform
    covariance: NDArray[np.float64]  # (6, 6), se3.log order, base frame
    inliers: NDArray[np.bool_]  # (N,), pixels agree
    depth_inliers: NDArray[np.bool_]  # (N,), depths agree too
    depth_agreement_ratio: float  # of the inliers that have a depth; 1 where none has


class PoseSolver:
    """Finds T_local_base; deterministic for a seed."""

    def __init__(self, camera: Camera, *, seed: int) -> None:
        self._camera, self._seed = camera, seed
        self._T_cam_base = se3.inverse(camera.T_base_cam)

    def search(self, measured: Measurements) -> Consensus | None:
        """Return the pose that most pixels agree with (AP3P, RANSAC), None where none is found."""
        if len(measured.uv_px) < 4:
            return None
        cv2.setRNGSeed(self._seed)
        found, rotvec, translation, inlier_rows = cv2.solvePnPRansac(
            measured.points_local,
            measured.uv_px,
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
        measures_depth = measured.depth_m > 0
        inliers, depth_inliers = np.ones(len(measures_depth), bool), measures_depth
        for steps in _ROUNDS:
            for _ in range(steps):
                residuals, jacobian = self._linearise(measured, T_local_base)
                weights = _huber_weights(residuals) * np.stack([inliers, inliers, depth_inliers])
                weighted = (jacobian * weights).reshape(6, -1)
                normal = np.einsum("ia,ja->ij", weighted, jacobian.reshape(6, -1))
                if not np.isfinite(normal).all() or np.linalg.cond(normal) > _MAX_CONDITION:
                    return None
                step = -np.linalg.solve(normal, weighted @ residuals.ravel())
                T_local_base = T_local_base @ se3.exp(step)
                if np.abs(step).max() < _SMALL_STEP:
                    break
            residuals, _ = self._linearise(measured, T_local_base)
            inliers = (residuals[:2] ** 2).sum(axis=0) <= _CHI2_PIXEL
            depth_inliers = inliers & measures_depth & (residuals[2] ** 2 <= _CHI2_DEPTH)
            if inliers.sum() < 4:
                return None
        # Where the errors are larger than their sigmas say, so is the covariance.
        pixel_variance = float((residuals[:2, inliers] ** 2).sum() / (2 * inliers.sum() - 6))
        covariance = np.linalg.inv(normal) * max(1.0, pixel_variance)
        return PoseEstimate(
            T_local_base=_orthonormal(T_local_base),
            covariance=0.5 * (covariance + covariance.T),
            inliers=inliers,
            depth_inliers=depth_inliers,
            depth_agreement_ratio=_share(depth_inliers, inliers & measures_depth),
        )

    def _linearise(
        self, measured: Measurements, T_local_base: Transform
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return residuals (3, N) in sigmas of u, v and 1/z, and their Jacobian (6, 3, N)."""
        camera = self._camera
        points_base = se3.apply(se3.inverse(T_local_base), measured.points_local)
        points_cam = se3.apply(self._T_cam_base, points_base)
        inverse_z = 1.0 / np.maximum(points_cam[:, 2], _MIN_DEPTH_M)
        x, y = points_cam[:, 0] * inverse_z, points_cam[:, 1] * inverse_z
        depth = np.where(measured.depth_m > 0, measured.depth_m, np.inf)
        per_px, per_m = 1.0 / measured.sigma_px, 1.0 / measured.inverse_depth_sigma_per_m
        residuals = np.stack(
            [
                (camera.fx * x + camera.cx - measured.uv_px[:, 0]) * per_px,
                (camera.fy * y + camera.cy - measured.uv_px[:, 1]) * per_px,
                (inverse_z - 1.0 / depth) * per_m,
            ]
        )
        by_point_cam = np.zeros((3, 3, len(x)))  # residual, component of the point
        by_point_cam[0, 0] = du = camera.fx * per_px * inverse_z
        by_point_cam[1, 1] = dv = camera.fy * per_px * inverse_z
        by_point_cam[0, 2], by_point_cam[1, 2] = -du * x, -dv * y
        by_point_cam[2, 2] = -(inverse_z**2) * per_m
        jacobian = np.empty((6, 3, len(x)))
        jacobian[:3] = -np.einsum("kjn,ji->ikn", by_point_cam, self._T_cam_base[:3, :3])
        p, move = points_base.T, jacobian[:3]
        # A turn phi of the base moves the point by points_base x phi.
        jacobian[3] = p[1] * move[2] - p[2] * move[1]
        jacobian[4] = p[2] * move[0] - p[0] * move[2]
        jacobian[5] = p[0] * move[1] - p[1] * move[0]
        return residuals, jacobian


def _huber_weights(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return weights (3, N); u and v share one, by their joint length."""
    pixel = np.hypot(residuals[0], residuals[1])
    sizes = np.stack([pixel, pixel, np.abs(residuals[2])])
    return np.asarray(_HUBER / np.maximum(sizes, _HUBER))


def _share(chosen: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(chosen.sum() / of.sum()) if of.any() else 1.0


def _orthonormal(T_a_b: Transform) -> Transform:
    """Return the transform without the rounding that many products leave in its rotation."""
    return se3.from_quat_xyzw(T_a_b[:3, 3], se3.to_quat_xyzw(T_a_b))
