"""What real cameras add to a clean view: photons, read-out, and the holes of a Kinect's depth.

Axial depth noise: C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect Sensor Noise for Improved
3D Reconstruction and Tracking", 3DIMPVT 2012.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.two_rooms.camera import View
from sceneslam.types.rig import Camera

_FULL_WELL = 6000.0  # photons that make white
_READ_NOISE = 9.0  # electrons
_LENS_SIGMA_PX = 0.5
_PROJECTOR_BASELINE_M = 0.075  # right of the camera: its shadows fall left of near things
_GRAZING_RAD = np.deg2rad(78.0)
_EDGE_STEP_RATIO = 0.03  # of the depth, across one pixel
_BLINDING_SUNLIGHT = 0.02  # irradiance in which the projected pattern is lost


def expose(view: View, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the image (H, W, 3) BGR of a view with photon and read noise, in 8 bits.

    The camera's response is the square root, so that photon noise is the same at all levels.
    """
    signal = np.asarray(cv2.GaussianBlur(view.image_bgr, (3, 3), _LENS_SIGMA_PX), np.float32)
    signal *= np.float32(1.0 / 255.0)
    signal *= signal  # photons; from here on in place, since fresh memory costs more than sums
    sigma = signal * np.float32(1.0 / _FULL_WELL)
    sigma += np.float32((_READ_NOISE / _FULL_WELL) ** 2)
    np.sqrt(sigma, out=sigma)
    sigma *= rng.standard_normal(signal.shape, dtype=np.float32)
    signal += sigma
    np.maximum(signal, 0.0, out=signal)
    np.sqrt(signal, out=signal)
    return np.asarray(cv2.convertScaleAbs(signal, alpha=255.0), dtype=np.uint8)


def measure_depth(view: View, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return the depth (H, W) [mm] that a Kinect reports of a view, 0 where it sees none."""
    near_m, far_m = camera.depth_range_m
    depth_m = np.where(np.isfinite(view.depth_m), view.depth_m, np.float32(2.0 * far_m))
    angle = np.arccos(np.minimum(view.cosine, 1.0))
    sigma = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    steep = angle / np.maximum(np.float32(np.pi / 2) - angle, 0.1)
    sigma += 0.0001 / np.sqrt(depth_m) * steep**2
    noise = rng.standard_normal(depth_m.shape, dtype=np.float32)
    measured = depth_m + sigma * noise
    valid = (measured >= near_m) & (measured <= far_m) & (angle < _GRAZING_RAD)
    valid &= ~_is_shadowed(depth_m, camera) & ~_is_edge(depth_m, rng)
    if view.sunlight is not None:
        valid &= view.sunlight < _BLINDING_SUNLIGHT
    return np.where(valid, np.rint(1000.0 * measured), 0.0).astype(np.uint16)


def _is_shadowed(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.bool_]:
    """Tell where the projector's light is held off by something nearer, further right."""
    disparity_px = np.float32(camera.fx * _PROJECTOR_BASELINE_M) / depth_m
    projected_px = np.arange(depth_m.shape[1], dtype=np.float32) - disparity_px
    least = np.minimum.accumulate(projected_px[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(projected_px > least + 0.5, dtype=np.bool_)


def _is_edge(depth_m: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Tell where depth steps, and two of three times in the pixels next to such a step."""
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.dilate(depth_m, kernel) - cv2.erode(depth_m, kernel)
    inverse = 1.0 / depth_m
    curvature = np.abs(cv2.Laplacian(inverse, cv2.CV_32F)) * depth_m  # a plane's inverse is flat
    edge = (step > _EDGE_STEP_RATIO * depth_m) & (curvature > 0.5 * _EDGE_STEP_RATIO)
    ragged = cv2.dilate(edge.astype(np.uint8), kernel).astype(np.bool_)
    return np.asarray(edge | (ragged & (rng.random(depth_m.shape, np.float32) < 2 / 3)), np.bool_)
