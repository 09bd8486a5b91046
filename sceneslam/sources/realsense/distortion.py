"""Conversion of RealSense lens distortion to OpenCV's model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyrealsense2 as rs

from sceneslam.types.errors import InputError

_GRID = 21  # grid points per axis for the fit
_LEFT_PX = 0.5  # largest residual of the fit: as accurate as image corners


def to_opencv(intrinsics: Any) -> tuple[float, ...]:
    """Return k1 k2 p1 p2 k3; raises InputError for a lens that this model does not fit.

    The SDK has several models, some of which map pixels to rays. For any of them, the coefficients
    are fitted by least squares to the rays of a grid of pixels: OpenCV's model is linear in them.
    """
    if intrinsics.model == rs.distortion.none or not any(intrinsics.coeffs):
        return (0.0, 0.0, 0.0, 0.0, 0.0)
    us, vs = np.linspace(0, intrinsics.width, _GRID), np.linspace(0, intrinsics.height, _GRID)
    pixels = np.stack(np.meshgrid(us, vs), axis=-1).reshape(-1, 2)
    rays = [rs.rs2_deproject_pixel_to_point(intrinsics, one, 1.0) for one in pixels.tolist()]
    x, y = np.array(rays)[:, :2].T
    centre, focal_px = (intrinsics.ppx, intrinsics.ppy), (intrinsics.fx, intrinsics.fy)
    off = (pixels - centre) / focal_px - np.stack([x, y], axis=1)
    r2 = x**2 + y**2
    along_x = [r2 * x, r2**2 * x, 2 * x * y, r2 + 2 * x**2, r2**3 * x]
    along_y = [r2 * y, r2**2 * y, r2 + 2 * y**2, 2 * x * y, r2**3 * y]
    slopes = np.concatenate([np.stack(along_x, axis=1), np.stack(along_y, axis=1)])
    wanted = np.concatenate([off[:, 0], off[:, 1]])
    fitted, *_ = np.linalg.lstsq(slopes, wanted, rcond=None)
    left_px = np.abs(slopes @ fitted - wanted).max() * max(focal_px)
    if not left_px <= _LEFT_PX:
        raise InputError(
            f"the lens distortion {intrinsics.model.name} is off by {left_px:.1f} pixels in "
            f"OpenCV's model (k1 k2 p1 p2 k3): at most {_LEFT_PX} is allowed"
        )
    return tuple(fitted.tolist())
