"""Features of an image that distinguish a failing camera from a difficult scene."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation

_WHITE = 250  # grey value that is nearly saturated
_FLOOR = 4.0  # grey values of read noise: ratios of smaller values are meaningless
_EDGE_STEP = 24.0  # grey values of an edge, across a 40th of the image's width
_EDGES_MIN = 40  # smallest number of edge pixels in the examined rows
_TEAR_STEP = 6.0  # smallest mean difference of grey values between the rows of a cut ...
_TEAR_RATIO = 2.0  # ... and smallest ratio to the difference of the rows beside it
_TEAR_REACH_RATIO = 0.02  # of the height: largest motion of an edge between images
_TEAR_IMAGES = 5
_FLICKER_STEP = 0.4  # smallest amplitude of flicker, in powers of two of light
_FLICKER_SPAN_NS = 1_000_000_000


def grey_peak(image_bgr: NDArray[np.uint8]) -> float:
    """Return the grey value that one pixel in a thousand of (H, W, 3) exceeds."""
    counts = np.bincount(_grey(image_bgr)[::2, ::2].ravel(), minlength=256)
    return float(np.searchsorted(np.cumsum(counts), 0.999 * counts.sum()))


def overexposed_ratio(image_bgr: NDArray[np.uint8]) -> float:
    """Return the share of pixels of (H, W, 3) that are nearly saturated."""
    grey = _grey(image_bgr)
    return float(cv2.countNonZero(cv2.inRange(grey, _WHITE, 255)) / grey.size)


def sharpness(image_bgr: NDArray[np.uint8]) -> float:
    """Return the share of the strongest edges' height within a 240th of the width, of (H, W, 3).

    It is about 1 for a step, near 0 for an image out of focus, and 1 without any edge. Noise has no
    effect, as edges are detected over a distance six times as long.
    """
    grey = _grey(image_bgr)
    reach = max(1, round(grey.shape[1] / 240))
    smooth = cv2.blur(grey, (1, 2 * reach + 1))[:: 2 * reach].astype(np.float32)
    near = np.abs(smooth[:, reach:] - smooth[:, :-reach])
    far_reach = 6 * reach
    far = np.abs(smooth[:, far_reach:] - smooth[:, :-far_reach])
    # The largest short step within each long one.
    width = far.shape[1]
    largest = cv2.dilate(near, np.ones((1, far_reach - reach + 1), np.uint8), anchor=(0, 0))
    is_edge = far > _EDGE_STEP
    if np.count_nonzero(is_edge) < _EDGES_MIN:
        return 1.0
    ratios = largest[:, :width][is_edge] / far[is_edge]
    return float(min(np.quantile(ratios, 0.9), 1.0))


@dataclass(slots=True)
class Tears:
    """Counts cuts of an image: rows above and below are from different images, or shifted.

    A cut is a difference between two rows, over the whole width, that neither the rows beside it
    have nor the previous image had there: edges of floors and shelves stay at their position.
    """

    _before: NDArray[np.float32] | None = None  # (H - 1,) differences of rows in the last image
    _recent: deque[int] = field(default_factory=lambda: deque(maxlen=_TEAR_IMAGES))

    def __call__(self, observation: Observation) -> float:
        """Return the mean number of cuts in the last five images."""
        if observation.image_bgr is not None:
            self._look(_grey(observation.image_bgr).astype(np.float32))
        return sum(self._recent) / len(self._recent) if self._recent else 0.0

    def _look(self, grey: NDArray[np.float32]) -> None:
        steps = np.asarray(np.abs(grey[1:] - grey[:-1]).mean(axis=1), np.float32)
        before, self._before = self._before, steps
        if before is None or before.shape != steps.shape:
            return
        reach = 2 * max(1, round(_TEAR_REACH_RATIO * len(steps))) + 1
        known = cv2.dilate(before[:, None], np.ones((reach, 1), np.uint8))[1:-1, 0]
        inner, beside = steps[1:-1], np.maximum(steps[:-2], steps[2:])
        is_cut = (inner > _TEAR_STEP) & (inner > _TEAR_RATIO * beside) & (inner > 2 * known)
        self._recent.append(int(np.count_nonzero(is_cut)))


@dataclass(slots=True)
class Flicker:
    """Measures the frequency of changes between bright and dim."""

    _turns_ns: deque[int] = field(default_factory=deque)
    _extreme: float | None = None
    _is_rising: bool | None = None

    def __call__(self, observation: Observation) -> float:
        """Return the number of full periods within the last second."""
        now_ns = observation.stamp_ns
        if observation.image_bgr is not None:
            mean = sum(cv2.mean(observation.image_bgr)[:3]) / 3.0
            self._follow(float(np.log2(mean + _FLOOR)), now_ns)
        while self._turns_ns and now_ns - self._turns_ns[0] > _FLICKER_SPAN_NS:
            self._turns_ns.popleft()
        return len(self._turns_ns) / 2.0

    def _follow(self, light: float, now_ns: int) -> None:
        if self._extreme is None:
            self._extreme = light
        step = light - self._extreme
        if self._is_rising is not None and (step > 0) == self._is_rising:
            self._extreme = light
        elif abs(step) > _FLICKER_STEP:
            self._extreme, self._is_rising = light, step > 0
            self._turns_ns.append(now_ns)


def _grey(image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY), np.uint8)
