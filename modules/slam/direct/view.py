"""Downscaled and undistorted images with depth, and their comparison."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.covariance import semidefinite
from sceneslam.types.rig import Camera
from sceneslam.types.spread import spread

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_STEP_PX = 4  # distance between compared pixels
_DEPTH_NOISE = (0.003, 0.0015)  # sigma = a + b z^2 [m], structured light
_GATE_SIGMAS = 5.0  # larger differences of depth are other surfaces
_GREY_SIGMA_MIN = 3.0  # grey values: smallest image noise
_CORRELATION = 100.0  # correlated pixels with the information of one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DirectView:
    """One image with its depth."""

    grey: NDArray[np.uint8]  # (h, w)
    depth_m: Floats  # (h, w), 0 = missing
    frame: Any  # prepared by OpenCV


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """The agreement of two views at a relative pose."""

    information: Doubles  # (6, 6) of se3.log order, cam
    compared: int  # pixels with depth in both views
    matched: int  # of these, on the same surface

    @property
    def matched_ratio(self) -> float:
        """Return the share of compared pixels that agree."""
        return self.matched / max(self.compared, 1)


class Tracker:
    """OpenCV's RGB-D odometry (Steinbruecker et al., 2011) on views of one camera."""

    def __init__(self, camera: Camera, width_px: int, step_max_m: float, turn_max_rad: float):
        full = np.array(camera.size_wh)
        scale = min(width_px / full[0], 1.0)
        self._size_wh = (round(full[0] * scale), round(full[1] * scale))
        resized = np.diag([scale, scale, 1.0])
        resized[:2, 2] = 0.5 * scale - 0.5  # pixel centres are at whole numbers
        self.K = resized @ camera.K
        distortion = np.array(camera.distortion)
        self._maps_grey = cv2.initUndistortRectifyMap(
            self.K, distortion, None, self.K, self._size_wh, cv2.CV_32FC1
        )
        self._maps_depth = cv2.initUndistortRectifyMap(
            camera.K, distortion, None, self.K, self._size_wh, cv2.CV_32FC1
        )
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(self.K.astype(np.float32))
        near_m, far_m = camera.depth_range_m
        settings.setMinDepth(near_m)
        settings.setMaxDepth(far_m)
        settings.setMaxTranslation(step_max_m)
        settings.setMaxRotation(float(np.rad2deg(turn_max_rad)))
        kind, method = cv2.OdometryType_RGB_DEPTH, cv2.OdometryAlgoType_COMMON
        self._odometry = cv2.Odometry(kind, settings, method)
        self._camera = camera

    def view(self, image_bgr: NDArray[np.uint8], depth_m: Floats) -> DirectView:
        """Return the view of an image (H, W, 3) and its depth (H, W) [m]."""
        grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
        grey = cv2.resize(grey, self._size_wh, interpolation=cv2.INTER_AREA)
        grey = cv2.remap(grey, *self._maps_grey, cv2.INTER_LINEAR)
        measured = np.where(self._camera.measures(depth_m), depth_m, np.float32(0))
        small_m = cv2.remap(measured, *self._maps_depth, cv2.INTER_NEAREST)
        frame = cv2.OdometryFrame(small_m, grey)
        self._odometry.prepareFrame(frame)
        return DirectView(
            grey=np.asarray(grey, np.uint8), depth_m=np.asarray(small_m, np.float32), frame=frame
        )

    def points(self, view: DirectView, stride_px: int) -> Floats:
        """Return every stride-th pixel's point (N, 3) [m], cam; z is 0 where depth is missing."""
        z = view.depth_m[::stride_px, ::stride_px]
        v, u = np.mgrid[: z.shape[0], : z.shape[1]] * stride_px
        x, y = (u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1]
        return np.stack([x * z, y * z, z], axis=-1).reshape(-1, 3).astype(np.float32)

    def register(self, view: DirectView, other: DirectView) -> se3.Transform | None:
        """Return T_other_view (4, 4) [m], None if the registration fails."""
        found, T_other_view = self._odometry.compute(view.frame, other.frame)
        if not found or not np.isfinite(T_other_view).all():
            return None
        return se3.orthonormal(np.asarray(T_other_view, np.float64))

    def compare(
        self, view: DirectView, other: DirectView, T_other_view: se3.Transform
    ) -> Comparison:
        """Return the agreement of two views at T_other_view (4, 4) [m], and its information."""
        # Project the view's points into the other image.
        points_view = self.points(view, _STEP_PX).astype(np.float64)
        greys = view.grey[::_STEP_PX, ::_STEP_PX].reshape(-1).astype(np.float64)
        points = np.asarray(se3.apply(T_other_view, points_view), np.float64)
        z = np.maximum(points[:, 2], 1e-6)
        pixels = points[:, :2] / z[:, None] * [self.K[0, 0], self.K[1, 1]] + self.K[:2, 2]
        place = np.rint(pixels).astype(np.int64)
        height, width = other.grey.shape
        inside = (points_view[:, 2] > 0) & (points[:, 2] > 0)
        inside &= (place >= 1).all(axis=1) & (place < [width - 1, height - 1]).all(axis=1)
        column, row = np.where(inside[:, None], place, 1).T
        depth_there = other.depth_m[row, column].astype(np.float64)
        inside &= depth_there > 0
        # Points match where the other depth agrees within its noise.
        sigma_m = _DEPTH_NOISE[0] + _DEPTH_NOISE[1] * z**2
        matched = inside & (np.abs(depth_there - z) < _GATE_SIGMAS * sigma_m)
        rows = np.flatnonzero(matched)
        information = np.zeros((6, 6))
        if len(rows):
            jacobians = _jacobians(points_view[rows], T_other_view, points[rows], self.K)
            slopes = _slopes(other, row[rows], column[rows])
            # Noise of grey values, by the differences.
            missed = other.grey[row[rows], column[rows]] - greys[rows]
            missed = missed - np.median(missed)  # exposure
            noise = spread(missed)
            grey_sigma = max(noise, _GREY_SIGMA_MIN)
            # Derivatives of both residuals, grey(pixel) and depth(pixel) - z, over their sigmas
            # (Steinbruecker et al., ICCVW 2011); the information is J' J.
            photometric = np.einsum("ni,nij->nj", slopes[:, 0], jacobians[:, :2]) / grey_sigma
            geometric = np.einsum("ni,nij->nj", slopes[:, 1], jacobians[:, :2]) - jacobians[:, 2]
            geometric /= sigma_m[rows, None]
            # A slope is half a difference of two greys, and so has half the variance of their
            # noise, a quarter of that of `missed`: by it, darkness would say where it is.
            by_noise = 0.5 * noise / grey_sigma * jacobians[:, :2].reshape(-1, 6)
            seen = photometric.T @ photometric - by_noise.T @ by_noise
            information = (semidefinite(seen) + geometric.T @ geometric) / _CORRELATION
        return Comparison(information=information, compared=int(inside.sum()), matched=len(rows))


def _jacobians(
    points_view: Doubles, T_other_view: se3.Transform, points: Doubles, K: Doubles
) -> Doubles:
    """Return (N, 3, 6): derivative of pixel and depth in the other view by the view's twist."""
    # Derivative of (u, v, z) by the point in the other camera: pinhole projection.
    x, y, z = points.T
    zero = np.zeros_like(z)
    projection = np.stack(
        [
            np.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2], axis=-1),
            np.stack([zero, K[1, 1] / z, -K[1, 1] * y / z**2], axis=-1),
            np.stack([zero, zero, np.ones_like(z)], axis=-1),
        ],
        axis=1,
    )
    # Derivative of the point by a twist on the right, T exp(xi): R (I, -[p]x).
    a, b, c = points_view.T
    minus_hat = np.stack(
        [
            np.stack([zero, c, -b], axis=-1),
            np.stack([-c, zero, a], axis=-1),
            np.stack([b, -a, zero], axis=-1),
        ],
        axis=1,
    )
    moved = np.concatenate([np.broadcast_to(np.eye(3), minus_hat.shape), minus_hat], axis=2)
    return np.asarray(projection @ (T_other_view[:3, :3] @ moved))


def _slopes(view: DirectView, row: NDArray[np.int64], column: NDArray[np.int64]) -> Doubles:
    """Return (N, 2, 2): gradients of grey value and depth [m] along x and y [1/px], at pixels."""
    found = []
    for picture in (view.grey.astype(np.float64), view.depth_m.astype(np.float64)):
        along_x = 0.5 * (picture[row, column + 1] - picture[row, column - 1])
        along_y = 0.5 * (picture[row + 1, column] - picture[row - 1, column])
        found.append(np.stack([along_x, along_y], axis=-1))
    depth = view.depth_m
    around = [depth[row, column + d] for d in (-1, 1)] + [depth[row + d, column] for d in (-1, 1)]
    steps = np.ptp(np.stack([*around, depth[row, column]]), axis=0)
    found[1][steps > 0.05 * depth[row, column]] = 0.0  # an edge, or missing neighbours: no gradient
    return np.stack(found, axis=1)
