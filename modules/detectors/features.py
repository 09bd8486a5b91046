"""What can be measured of an observation in a millisecond or two, each as one number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Sensor

from .grey_mean import grey_mean

_USABLE = (16, 239)  # grey values that are neither lost in read noise nor saturated
_CORNER_STEP = 20  # grey values; OpenCV's ORB begins with it
_SCAN_SPAN = 4  # beams to either side that tell a surface's direction
_SCAN_STEP_M = 0.3  # neighbouring returns farther apart lie on different surfaces


@dataclass(frozen=True, slots=True, kw_only=True)
class Feature:
    """A number of an observation, NaN where its sensor was silent."""

    sensor: Sensor
    measure: Callable[[Observation], float]


def usable_ratio(image_bgr: NDArray[np.uint8]) -> float:
    """Return the share of pixels that are neither black nor white: exposure does not hide it."""
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    return float(cv2.countNonZero(cv2.inRange(grey, *_USABLE)) / grey.size)


def corner_count(image_bgr: NDArray[np.uint8]) -> float:
    """Return the FAST corners per 100 x 100 pixels: what features can be found on."""
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    corners = cv2.FastFeatureDetector.create(threshold=_CORNER_STEP).detect(grey)
    return len(corners) / grey.size * 1e4


def depth_ratio(depth_m: NDArray[np.float32]) -> float:
    """Return the share of pixels that have a depth: sunlight and far walls take it away."""
    return float(np.count_nonzero(depth_m > 0) / depth_m.size)


def scan_hold(scan: LaserScan) -> float:
    """Return how well a scan's surfaces hold its weakest direction: 0 (a bare corridor) to 1.

    Twice the smaller eigenvalue of the mean of n n' over the surfaces' normals n; 0 without any.
    """
    x = scan.ranges_m * np.cos(scan.angles_rad)
    y = scan.ranges_m * np.sin(scan.angles_rad)
    along = np.column_stack([x[_SCAN_SPAN:] - x[:-_SCAN_SPAN], y[_SCAN_SPAN:] - y[:-_SCAN_SPAN]])
    length_m = np.hypot(*along.T)
    with np.errstate(invalid="ignore"):
        on_surface = (length_m > 1e-6) & (length_m < _SCAN_STEP_M)
    if not on_surface.any():
        return 0.0
    direction = along[on_surface] / length_m[on_surface, None]
    return 2.0 * float(np.linalg.eigvalsh(direction.T @ direction / len(direction))[0])


def _of_image(measure: Callable[[NDArray[np.uint8]], float]) -> Feature:
    def told(one: Observation) -> float:
        return np.nan if one.image_bgr is None else measure(one.image_bgr)

    return Feature(sensor=Sensor.IMAGE, measure=told)


def _depth(one: Observation) -> float:
    return np.nan if one.depth_m is None else depth_ratio(one.depth_m)


def _scan(one: Observation) -> float:
    return np.nan if one.scan is None else scan_hold(one.scan)


FEATURES: Mapping[str, Feature] = {
    "grey_mean": _of_image(grey_mean),
    "usable_ratio": _of_image(usable_ratio),
    "corner_count": _of_image(corner_count),
    "depth_ratio": Feature(sensor=Sensor.DEPTH, measure=_depth),
    "scan_hold": Feature(sensor=Sensor.SCAN, measure=_scan),
}
