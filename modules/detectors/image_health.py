"""What tells a camera that fails from a scene that is poor, each as one number of an image."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.observation import Observation

_WHITE = 250  # grey value that is nearly saturated
_FLOOR = 4.0  # grey values of read noise: below, a ratio of light means nothing
_EDGE_STEP = 24.0  # grey values of an edge, across a 40th of the image's width
_EDGES_MIN = 40  # pixels on edges, of every second row or fewer, to judge an image by
_TEAR_STEP = 6.0  # grey values between the rows of a cut, on average over the width ...
_TEAR_RATIO = 2.0  # ... and so many times the steps between the rows beside it
_TEAR_REACH_RATIO = 0.02  # of the height, by which an edge moves from image to image
_TEAR_IMAGES = 5
_FLICKER_STEP = 0.4  # powers of two of light between the extremes of a flicker
_FLICKER_SPAN_NS = 1_000_000_000


def grey_peak(image_bgr: NDArray[np.uint8]) -> float:
    """Return the grey value that one pixel in a thousand exceeds: what little light there is."""
    counts = np.bincount(_grey(image_bgr)[::2, ::2].ravel(), minlength=256)
    return float(np.searchsorted(np.cumsum(counts), 0.999 * counts.sum()))


def overexposed_ratio(image_bgr: NDArray[np.uint8]) -> float:
    """Return the share of pixels that are nearly saturated."""
    grey = _grey(image_bgr)
    return float(cv2.countNonZero(cv2.inRange(grey, _WHITE, 255)) / grey.size)


def sharpness(image_bgr: NDArray[np.uint8]) -> float:
    """Return how much of the strongest edges' height lies within a 240th of the image's width.

    About 1 for a step, near 0 for an image out of focus; 1 where there is no edge to judge by.
    Noise counts for neither: edges are taken over a distance six times as long.
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
    """Counts where an image is cut: rows above and below do not belong together.

    A cut is a step between two rows, over the whole width, that neither the rows beside it have
    nor the image before had there: the edges of floors and shelves stay where they are.
    """

    _before: NDArray[np.float32] | None = None  # (H - 1,) the steps of the last image
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
    """Counts how often a second the light turns between bright and dim."""

    _turns_ns: deque[int] = field(default_factory=deque)
    _extreme: float | None = None
    _is_rising: bool | None = None

    def __call__(self, observation: Observation) -> float:
        """Return the full periods within the last second."""
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
