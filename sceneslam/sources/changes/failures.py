"""Models of sensor failures; each changes the measurements of one sensor only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.ros.pixels import locked
from sceneslam.types import se3
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform

Image = NDArray[np.uint8]  # (H, W, 3) BGR
Depth = NDArray[np.float32]  # (H, W) [m]
Random = np.random.Generator


class Failure(Protocol):
    """A failure of one sensor; it is given all observations, by rising stamp."""

    def pass_on(self, observation: Observation, *, is_failing: bool) -> Observation:
        """Return the observation, with the sensor's measurement changed if it is failing."""
        ...


@dataclass(slots=True)
class _Spoilt:
    """A failure that changes each measurement by itself: (value, stamp [ns]) -> value or None."""

    name: str  # of the field of Observation
    change: Callable[[Any, int], Any]

    def pass_on(self, observation: Observation, *, is_failing: bool) -> Observation:
        value = getattr(observation, self.name)
        if not is_failing or value is None:
            return observation
        changed = self.change(value, observation.stamp_ns)
        if isinstance(changed, np.ndarray):
            changed = locked(changed)
        return replace(observation, **{self.name: changed})


@dataclass(slots=True)
class _Frozen:
    """A sensor that repeats its first measurement of the failure."""

    name: str
    _first: Any = None

    def pass_on(self, observation: Observation, *, is_failing: bool) -> Observation:
        value = getattr(observation, self.name)
        if not is_failing or value is None:
            self._first = None if not is_failing else self._first
            return observation
        self._first = value if self._first is None else self._first
        repeated = self._first
        if isinstance(repeated, LaserScan):
            repeated = replace(repeated, stamp_ns=value.stamp_ns)
        return replace(observation, **{self.name: repeated})


@dataclass(slots=True)
class _Wheels:
    """Wheel encoders that measure `ratio` times the motion; odometry integrates it."""

    ratio: float  # 0: rotation is not measured either
    _T_true: Transform | None = None  # last odometry of the source ...
    _T_counted: Transform | None = None  # ... and as passed on, from the first failure on

    def pass_on(self, observation: Observation, *, is_failing: bool) -> Observation:
        T_odom_base = observation.T_odom_base
        if T_odom_base is None or not np.isfinite(T_odom_base).all():
            return observation
        T_true, self._T_true = self._T_true, T_odom_base
        if T_true is None or (self._T_counted is None and not is_failing):
            return observation
        T_prev_curr = se3.inverse(T_true) @ T_odom_base
        if is_failing:
            T_prev_curr[:3, 3] *= self.ratio
            T_prev_curr = se3.identity() if self.ratio == 0 else T_prev_curr
        T_counted = T_true if self._T_counted is None else self._T_counted
        self._T_counted = se3.chained(T_counted, T_prev_curr)
        return replace(observation, T_odom_base=locked(self._T_counted))


@dataclass(slots=True)
class _Dirt:
    """Three to eight dark spots on the lens, with soft edges because they are out of focus."""

    rng: Random
    _cover: NDArray[np.float32] | None = None  # (H, W, 1) 0 (clean) to 1

    def __call__(self, image_bgr: Image, stamp_ns: int) -> Image:
        height, width = image_bgr.shape[:2]
        if self._cover is None or self._cover.shape[:2] != (height, width):
            self._cover = self._spots(height, width)
        spoilt = image_bgr * (1.0 - self._cover) + 35.0 * self._cover
        return np.asarray(spoilt, np.uint8)

    def _spots(self, height: int, width: int) -> NDArray[np.float32]:
        cover = np.zeros((height, width), np.float32)
        for _ in range(int(self.rng.integers(3, 9))):
            centre = (int(self.rng.integers(width)), int(self.rng.integers(height)))
            radius_px = int(self.rng.uniform(0.06, 0.14) * width)
            cv2.circle(cover, centre, radius_px, float(self.rng.uniform(0.85, 1.0)), -1)
        soft = cv2.GaussianBlur(cover, (0, 0), 0.012 * width)
        return np.asarray(soft, np.float32)[..., None]


def _silent(value: object, stamp_ns: int) -> None:
    return None


def _black(rng: Random, image_bgr: Image, stamp_ns: int) -> Image:
    """Return the image of a covered lens: sensor noise."""
    return rng.integers(0, 3, image_bgr.shape, np.uint8)


def _overexposed(gain: float, image_bgr: Image, stamp_ns: int) -> Image:
    return np.asarray(cv2.convertScaleAbs(image_bgr, alpha=gain), np.uint8)


def _blurred(rng: Random, sigma_ratio: float, image_bgr: Image, stamp_ns: int) -> Image:
    """Return a defocused image; the sensor's noise is added after the blur."""
    soft = cv2.GaussianBlur(image_bgr, (0, 0), sigma_ratio * image_bgr.shape[1])
    noisy = soft.astype(np.int16) + rng.integers(-2, 3, image_bgr.shape, np.int16)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def _flickering(rate_hz: float, low: float, image_bgr: Image, stamp_ns: int) -> Image:
    is_low = (stamp_ns * 1e-9 * rate_hz) % 1.0 < 0.5
    return np.asarray(cv2.convertScaleAbs(image_bgr, alpha=low), np.uint8) if is_low else image_bgr


def _torn(rng: Random, image_bgr: Image, stamp_ns: int) -> Image:
    """Return an image with lost packets: below some rows it is shifted sideways."""
    torn = image_bgr.copy()
    height, width = image_bgr.shape[:2]
    for row in np.sort(rng.integers(0, height, int(rng.integers(3, 7)))).tolist():
        torn[row:] = np.roll(torn[row:], int(rng.uniform(0.1, 0.9) * width), axis=1)
    return torn


def _empty(depth_m: Depth, stamp_ns: int) -> Depth:
    return np.zeros_like(depth_m)


def _noisy(rng: Random, share: float, depth_m: Depth, stamp_ns: int) -> Depth:
    """Return depth with a share of random pixels, as when two projectors interfere."""
    wild_m = rng.uniform(0.3, 8.0, depth_m.shape).astype(np.float32)
    return np.where(rng.random(depth_m.shape) < share, wild_m, depth_m)


def _covered(rng: Random, share: float, scan: LaserScan, stamp_ns: int) -> LaserScan:
    """Return a scan most of whose beams, or all, end on an object on the scanner's window."""
    ranges_m = scan.ranges_m.copy()
    count = round(share * len(ranges_m))
    ranges_m[:count] = scan.range_min_m + rng.uniform(0.0, 0.03, count)
    return replace(scan, ranges_m=locked(ranges_m))


def _without_returns(scan: LaserScan, stamp_ns: int) -> LaserScan:
    return replace(scan, ranges_m=locked(np.full_like(scan.ranges_m, np.inf)))


FAILURES: Mapping[str, Callable[[Random], Failure]] = {
    "camera_silent": lambda rng: _Spoilt("image_bgr", _silent),
    "camera_frozen": lambda rng: _Frozen("image_bgr"),
    "camera_black": lambda rng: _Spoilt("image_bgr", partial(_black, rng)),
    "camera_overexposed": lambda rng: _Spoilt(
        "image_bgr", partial(_overexposed, rng.uniform(4.0, 8.0))
    ),
    "camera_blurred": lambda rng: _Spoilt(
        "image_bgr", partial(_blurred, rng, rng.uniform(0.01, 0.02))
    ),
    "camera_dirty": lambda rng: _Spoilt("image_bgr", _Dirt(rng)),
    "camera_flicker": lambda rng: _Spoilt(
        "image_bgr", partial(_flickering, rng.uniform(2.0, 3.5), rng.uniform(0.25, 0.5))
    ),
    "camera_torn": lambda rng: _Spoilt("image_bgr", partial(_torn, rng)),
    "depth_silent": lambda rng: _Spoilt("depth_m", _silent),
    "depth_frozen": lambda rng: _Frozen("depth_m"),
    "depth_blinded": lambda rng: _Spoilt("depth_m", _empty),
    "depth_noisy": lambda rng: _Spoilt("depth_m", partial(_noisy, rng, rng.uniform(0.15, 0.4))),
    "laser_silent": lambda rng: _Spoilt("scan", _silent),
    "laser_frozen": lambda rng: _Frozen("scan"),
    "laser_covered": lambda rng: _Spoilt("scan", partial(_covered, rng, rng.uniform(0.8, 1.0))),
    "laser_blinded": lambda rng: _Spoilt("scan", _without_returns),
    "wheels_silent": lambda rng: _Spoilt("T_odom_base", _silent),
    "wheels_frozen": lambda rng: _Wheels(0.0),
    "wheels_slipping": lambda rng: _Wheels(rng.uniform(1.6, 3.0)),
    "wheels_reversed": lambda rng: _Wheels(-1.0),
}


_SENSORS = {
    "camera": Sensor.IMAGE,
    "depth": Sensor.DEPTH,
    "laser": Sensor.SCAN,
    "wheels": Sensor.ODOMETRY,
}


def sensor_of(failure: str) -> Sensor:
    """Return the sensor that a failure changes."""
    return _SENSORS[failure.partition("_")[0]]


def scene_of(failure: str) -> str:
    """Return the name of a failure's scene: CameraFrozen for camera_frozen."""
    return "".join(word.title() for word in failure.split("_"))
