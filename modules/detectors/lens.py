"""Detection of dirt on a lens: image regions that do not move while the robot turns."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig

_WIDTH_PX = 96  # width of the downscaled images
_TURN_RAD = 0.15  # rotation between two images: 15 % of a field of view of 57 degrees
_SPAN_NS = 2_000_000_000  # longest time for this rotation, and validity of a result
_FINDINGS = 7  # results in the median: an edge may stay by chance in one or two images
_REACH_PX = 9  # tolerance for parallax, translation and tilt
_STAYED, _MOVED = 8, 16  # grey values: unmoved if below, moved if above


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    stamp_ns: int
    yaw_rad: float
    grey: NDArray[np.uint8]  # (h, _WIDTH_PX)


@dataclass(slots=True)
class Dirt:
    """Compares images before and after a rotation of the robot: the view moves, dirt does not.

    A pixel is dirty if it has not changed, and differs from the pixels that the rotation moves
    there. The result is 0 without a camera, or without gyro and wheels.
    """

    rig: Rig
    _views: deque[_View] = field(default_factory=deque)
    _yaw_rad: float = 0.0
    _last: Observation | None = None
    _found: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=_FINDINGS))

    def __call__(self, observation: Observation) -> float:
        """Return the dirty share of the image, the median of the last results."""
        self._turn(observation)
        if observation.image_bgr is not None and self.rig.camera is not None:
            self._compare(observation.stamp_ns, observation.image_bgr, self.rig.camera.fx)
        while self._found and observation.stamp_ns - self._found[0][0] > _SPAN_NS:
            self._found.popleft()
        return median(ratio for _, ratio in self._found) if self._found else 0.0

    def _turn(self, observation: Observation) -> None:
        """Integrate the robot's yaw by the gyro, else by the wheels."""
        before, self._last = self._last, observation
        if before is None:
            return
        turn = observation.turn_by_gyro((observation.stamp_ns - before.stamp_ns) * 1e-9)
        if turn is not None:
            self._yaw_rad += float(turn[2])
        elif before.T_odom_base is not None and observation.T_odom_base is not None:
            T_prev_curr = se3.inverse(before.T_odom_base) @ observation.T_odom_base
            yaw_rad = se3.yaw_rad(T_prev_curr)
            self._yaw_rad += yaw_rad if np.isfinite(yaw_rad) else 0.0

    def _compare(self, stamp_ns: int, image_bgr: NDArray[np.uint8], fx_px: float) -> None:
        height, width = image_bgr.shape[:2]
        size = (_WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))
        grey = cv2.cvtColor(
            cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY
        )
        now = _View(stamp_ns=stamp_ns, yaw_rad=self._yaw_rad, grey=np.asarray(grey, np.uint8))
        while self._views and stamp_ns - self._views[0].stamp_ns > _SPAN_NS:
            self._views.popleft()
        turned = (
            view for view in reversed(self._views) if abs(now.yaw_rad - view.yaw_rad) >= _TURN_RAD
        )
        before = next(turned, None)
        if self._views and np.array_equal(now.grey, self._views[-1].grey):
            before = None  # the image is frozen
            self._views.clear()
        self._views.append(now)
        if before is None:
            return
        # A rotation to the left moves the view to the right.
        shift_px = round(fx_px / width * _WIDTH_PX * np.tan(now.yaw_rad - before.yaw_rad))
        if 0 < abs(shift_px) <= _WIDTH_PX // 2:
            self._found.append((stamp_ns, _dirty_ratio(before.grey, now.grey, shift_px)))


def _dirty_ratio(before: NDArray[np.uint8], now: NDArray[np.uint8], shift_px: int) -> float:
    """Return the share of pixels that did not move although all should have moved to the right."""
    around = np.ones((_REACH_PX, _REACH_PX), np.uint8)
    to = slice(shift_px, None) if shift_px > 0 else slice(None, shift_px)
    come_from = slice(None, -shift_px) if shift_px > 0 else slice(-shift_px, None)
    low = cv2.erode(before, around)[:, come_from]
    high = cv2.dilate(before, around)[:, come_from]
    seen = now[:, to]
    off = cv2.max(cv2.subtract(seen, high), cv2.subtract(low, seen))
    stayed = cv2.absdiff(seen, before[:, to]) < _STAYED
    return float(np.count_nonzero(stayed & (off > _MOVED)) / seen.size)
