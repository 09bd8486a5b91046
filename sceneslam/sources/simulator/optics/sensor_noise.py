"""Sensor noise of cameras: shot noise, read noise, and noise and missing pixels of Kinect depth.

Axial depth noise: C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect Sensor Noise for Improved 3D
Reconstruction and Tracking", 3DIMPVT 2012.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.optics.camera import RenderedView
from sceneslam.sources.simulator.optics.exposure import NOMINAL, Shutter
from sceneslam.sources.simulator.optics.noise_table import NoiseTable
from sceneslam.types.rig import Camera

_FULL_WELL = 6000.0  # electrons of a saturated pixel
_READ_NOISE = 9.0  # electrons
_LENS_SIGMA_PX = 0.5
_SHARP_PX = 0.7  # less motion during the exposure is not visible
_PROJECTOR_BASELINE_M = 0.075  # right of the camera: shadows lie left of near objects
_GRAZING_COSINE = np.float32(np.cos(np.deg2rad(78.0)))
_STEEP_COSINE = np.float32(np.cos(np.deg2rad(30.0)))  # below this angle, it adds less than 0.05 mm
_SPARED = np.float32(0.43)  # a third of all standard normal numbers lie above
_EDGE_STEP_RATIO = 0.03  # change of depth across one pixel, relative to depth


def expose(
    view: RenderedView, noise: NoiseTable, rng: np.random.Generator, shutter: Shutter = NOMINAL
) -> NDArray[np.uint8]:
    """Return the BGR image (H, W, 3) of a view with shot and read noise, in 8 bits.

    The camera's response is the square root, so that shot noise is the same at all levels.
    """
    signal = np.asarray(cv2.GaussianBlur(view.image_bgr, (3, 3), _LENS_SIGMA_PX), np.float32)
    signal *= np.float32(np.sqrt(shutter.time_ratio) / 255.0)
    signal *= signal  # electrons; in place from here on, since allocation is slow
    signal = _blur(signal, shutter.motion_px)
    np.minimum(signal, 1.0, out=signal)  # saturation
    sigma = signal * np.float32(1.0 / _FULL_WELL)
    sigma += np.float32((_READ_NOISE / _FULL_WELL) ** 2)
    np.sqrt(sigma, out=sigma)
    sigma *= noise.normals(rng, signal.shape)
    signal += sigma
    np.maximum(signal, 0.0, out=signal)
    np.sqrt(signal, out=signal)
    alpha = 255.0 * np.sqrt(shutter.gain)
    return np.asarray(cv2.convertScaleAbs(signal, alpha=alpha), dtype=np.uint8)


def measure_depth(
    view: RenderedView, camera: Camera, noise: NoiseTable, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the depth (H, W) [mm] that a Kinect measures of a view, 0 = missing."""
    near_m, far_m = camera.depth_range_m
    depth_m = np.where(np.isfinite(view.depth_m), view.depth_m, np.float32(2.0 * far_m))
    measured = _depth_sigma_m(depth_m, view.cosine)
    measured *= noise.normals(rng, depth_m.shape)
    measured += depth_m
    valid = (measured >= near_m) & (measured <= far_m) & (view.cosine > _GRAZING_COSINE)
    valid &= ~_is_shadowed(depth_m, camera) & ~_is_edge(depth_m, noise.normals(rng, depth_m.shape))
    valid &= ~view.blinded
    measured *= np.float32(1000.0)
    np.rint(measured, out=measured)
    measured *= valid
    return measured.astype(np.uint16)


def _depth_sigma_m(
    depth_m: NDArray[np.float32], cosine: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the standard deviation (H, W) [m] of a Kinect's depth: by depth and angle."""
    sigma = depth_m - np.float32(0.4)
    sigma *= sigma
    sigma *= np.float32(0.0019)
    sigma += np.float32(0.0012)
    steep = np.flatnonzero(cosine < _STEEP_COSINE)
    angle = np.arccos(cosine.reshape(-1)[steep])
    factor = angle / np.maximum(np.float32(np.pi / 2) - angle, np.float32(0.1))
    near = np.sqrt(depth_m.reshape(-1)[steep])
    sigma.reshape(-1)[steep] += np.float32(0.0001) / near * factor**2
    return np.asarray(sigma)


def _blur(signal: NDArray[np.float32], motion_px: tuple[float, float]) -> NDArray[np.float32]:
    """Return the light with motion blur along the image's motion during the exposure."""
    length_px = float(np.hypot(*motion_px))
    if length_px < _SHARP_PX:
        return signal
    reach = int(np.ceil(length_px / 2))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    along = np.linspace(-0.5, 0.5, 8 * reach + 1)
    at = np.rint(reach + along[:, None] * motion_px).astype(int)
    np.add.at(kernel, (at[:, 1], at[:, 0]), 1.0 / len(along))
    return np.asarray(cv2.filter2D(signal, -1, kernel, borderType=cv2.BORDER_REPLICATE))


def _is_shadowed(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.bool_]:
    """Return (H, W) where a nearer object to the right blocks the projector's light."""
    disparity_px = np.float32(camera.fx * _PROJECTOR_BASELINE_M) / depth_m
    projected_px = np.arange(depth_m.shape[1], dtype=np.float32) - disparity_px
    least = np.minimum.accumulate(projected_px[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(projected_px > least + 0.5, dtype=np.bool_)


def _is_edge(depth_m: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return (H, W) where depth has a step, and two thirds of the pixels beside a step."""
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.dilate(depth_m, kernel) - cv2.erode(depth_m, kernel)
    inverse = 1.0 / depth_m
    curvature = np.abs(cv2.Laplacian(inverse, cv2.CV_32F)) * depth_m  # 0 on a plane
    edge = (step > _EDGE_STEP_RATIO * depth_m) & (curvature > 0.5 * _EDGE_STEP_RATIO)
    ragged = cv2.dilate(edge.astype(np.uint8), kernel).astype(np.bool_)
    return np.asarray(edge | (ragged & (normals < _SPARED)), np.bool_)
