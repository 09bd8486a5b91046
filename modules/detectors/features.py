"""Features of an observation, each one number, computed within one or two milliseconds.

FEATURES depend on one observation only, FEATURES_OVER_TIME also on earlier ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Rig, Sensor

from . import image_health
from .grey_mean import grey_mean
from .lens import Dirt
from .silence import Frozen, Silent
from .wheel_check import WheelCheck

_USABLE = (16, 239)  # grey values that are neither lost in read noise nor saturated
_CORNER_STEP = 20  # grey values; the default of OpenCV's ORB
_SCAN_SPAN = 4  # neighbouring beams to either side for a surface's normal
_SCAN_STEP_M = 0.3  # neighbouring returns farther apart lie on different surfaces


_NEAR_M = 0.1  # beyond a scanner's shortest range: nearer returns are from its window
_DEPTH_STEP_RATIO = 0.1  # of the depth: pixels that differ by more are of different surfaces

Measure = Callable[[Observation], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Feature:
    """A function that computes one number of an observation, NaN if its sensor is missing."""

    sensor: Sensor
    measure: Measure


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureOverTime:
    """A number of all observations so far, never NaN; `make` returns a new computation."""

    sensor: Sensor  # required sensor
    make: Callable[[Rig], Measure]


def usable_ratio(image_bgr: NDArray[np.uint8]) -> float:
    """Return the share of pixels of (H, W, 3) that are neither too dark nor saturated."""
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    return float(cv2.countNonZero(cv2.inRange(grey, *_USABLE)) / grey.size)


def corner_count(image_bgr: NDArray[np.uint8]) -> float:
    """Return the number of FAST corners per 100 x 100 pixels of (H, W, 3)."""
    grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    corners = cv2.FastFeatureDetector.create(threshold=_CORNER_STEP).detect(grey)
    return len(corners) / grey.size * 1e4


def depth_ratio(depth_m: NDArray[np.float32]) -> float:
    """Return the share of pixels of (H, W) with depth, which sunlight and far walls reduce."""
    return float(np.count_nonzero(depth_m > 0) / depth_m.size)


def depth_noise_ratio(depth_m: NDArray[np.float32]) -> float:
    """Return the share of pixels in the middle of (H, W) that differ from all four neighbours."""
    height, width = depth_m.shape
    middle_m = depth_m[height // 4 : height - height // 4, width // 4 : width - width // 4]
    inner_m = middle_m[1:-1, 1:-1]
    beside_m = (middle_m[:-2, 1:-1], middle_m[2:, 1:-1], middle_m[1:-1, :-2], middle_m[1:-1, 2:])
    nearest_m = np.minimum.reduce([np.abs(inner_m - other_m) for other_m in beside_m])
    is_measured = inner_m > 0
    count = np.count_nonzero(is_measured)
    is_wild = is_measured & (nearest_m > _DEPTH_STEP_RATIO * inner_m)
    return float(np.count_nonzero(is_wild) / count) if count else 0.0


def scan_near_ratio(scan: LaserScan) -> float:
    """Return the share of beams that end on the scanner's window."""
    return float(np.mean(scan.ranges_m < scan.range_min_m + _NEAR_M))


def scan_return_ratio(scan: LaserScan) -> float:
    """Return the share of beams with a return."""
    return float(np.mean(np.isfinite(scan.ranges_m)))


def scan_hold(scan: LaserScan) -> float:
    """Return how well a scan constrains translation in its weakest direction, 0 to 1.

    It is twice the smaller eigenvalue of the mean of n n' over the surfaces' normals n; 0 without
    any.
    """
    with np.errstate(invalid="ignore"):  # beams without a return
        x = scan.ranges_m * np.cos(scan.angles_rad)
        y = scan.ranges_m * np.sin(scan.angles_rad)
        along = np.column_stack(
            [x[_SCAN_SPAN:] - x[:-_SCAN_SPAN], y[_SCAN_SPAN:] - y[:-_SCAN_SPAN]]
        )
        length_m = np.hypot(*along.T)
        on_surface = (length_m > 1e-6) & (length_m < _SCAN_STEP_M)
    if not on_surface.any():
        return 0.0
    direction = along[on_surface] / length_m[on_surface, None]
    return 2.0 * float(np.linalg.eigvalsh(direction.T @ direction / len(direction))[0])


def _of_image(measure: Callable[[NDArray[np.uint8]], float]) -> Feature:
    return Feature(
        sensor=Sensor.IMAGE,
        measure=lambda one: np.nan if one.image_bgr is None else measure(one.image_bgr),
    )


def _of_depth(measure: Callable[[NDArray[np.float32]], float]) -> Feature:
    return Feature(
        sensor=Sensor.DEPTH,
        measure=lambda one: np.nan if one.depth_m is None else measure(one.depth_m),
    )


def _of_scan(measure: Callable[[LaserScan], float]) -> Feature:
    return Feature(
        sensor=Sensor.SCAN, measure=lambda one: np.nan if one.scan is None else measure(one.scan)
    )


FEATURES: Mapping[str, Feature] = {
    "grey_mean": _of_image(grey_mean),
    "usable_ratio": _of_image(usable_ratio),
    "corner_count": _of_image(corner_count),
    "grey_peak": _of_image(image_health.grey_peak),
    "overexposed_ratio": _of_image(image_health.overexposed_ratio),
    "sharpness": _of_image(image_health.sharpness),
    "depth_ratio": _of_depth(depth_ratio),
    "depth_noise_ratio": _of_depth(depth_noise_ratio),
    "scan_hold": _of_scan(scan_hold),
    "scan_near_ratio": _of_scan(scan_near_ratio),
    "scan_return_ratio": _of_scan(scan_return_ratio),
}


def _image(one: Observation) -> NDArray[np.uint8] | None:
    return one.image_bgr


def _depth(one: Observation) -> NDArray[np.float32] | None:
    return one.depth_m


def _ranges(one: Observation) -> NDArray[np.float32] | None:
    return None if one.scan is None else one.scan.ranges_m


def _odometry(one: Observation) -> NDArray[np.float64] | None:
    return one.T_odom_base


def _over_time(sensor: Sensor, make: Callable[[], Measure]) -> FeatureOverTime:
    return FeatureOverTime(sensor=sensor, make=lambda rig: make())


FEATURES_OVER_TIME: Mapping[str, FeatureOverTime] = {
    "image_silent_s": _over_time(Sensor.IMAGE, lambda: Silent(_image)),
    "depth_silent_s": _over_time(Sensor.DEPTH, lambda: Silent(_depth)),
    "scan_silent_s": _over_time(Sensor.SCAN, lambda: Silent(_ranges)),
    "odometry_silent_s": _over_time(Sensor.ODOMETRY, lambda: Silent(_odometry)),
    "image_frozen_s": _over_time(Sensor.IMAGE, lambda: Frozen(_image)),
    "depth_frozen_s": _over_time(Sensor.DEPTH, lambda: Frozen(_depth)),
    "scan_frozen_s": _over_time(Sensor.SCAN, lambda: Frozen(_ranges, needs_motion=True)),
    "flicker_hz": _over_time(Sensor.IMAGE, image_health.Flicker),
    "tear_count": _over_time(Sensor.IMAGE, image_health.Tears),
    "dirt_ratio": FeatureOverTime(sensor=Sensor.IMAGE, make=Dirt),
    "wheel_ratio": FeatureOverTime(sensor=Sensor.ODOMETRY, make=WheelCheck),
}
