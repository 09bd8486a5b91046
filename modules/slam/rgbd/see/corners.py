"""Corners of one image: ORB on each level of a pyramid, in two threads, spread over the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.views.grey_noise import grey_noise

from ..settings import RgbdSettings
from .cores import thread_beside

LEVELS = 8
SCALE = 1.2  # between two levels of the pyramid
_FIRST, _REST, _BESIDE = (0,), (3, 5, 6, 7), (1, 2, 4)  # levels; both threads take equally long
_CELL_PX = 40  # side of the cells that share out the corners
_SURPLUS = 2  # corners detected per corner kept
_BOLDNESS = 0.8  # share of the last image's weakest corner, as the first threshold
_THRESHOLD_MAX = 20  # ORB's own default, right for a bright and clean image
_STRONGEST = 255  # grey step
_ROW_BY_ROW = np.array([1e-4, 1.0])  # weights that order pixels (u, v) by row
_ROW_BITS = 20  # of a sort key that holds a row below

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corners:
    """Corners with their descriptors."""

    uv_px: NDArray[np.float64]  # (N, 2), in pixels of the image
    levels: NDArray[np.int64]  # (N,), of the pyramid, ascending
    descriptors: NDArray[np.uint8]  # (N, 32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Detected:
    """Corners of one level, strongest first, before they are spread over the image."""

    keypoints: Sequence[cv2.KeyPoint]  # (N,)
    uv_px: NDArray[np.float64]  # (N, 2), in pixels of the image
    cells: NDArray[np.int64]  # (N,)
    strength: NDArray[np.int64]  # (N,), up to _STRONGEST


class _Octave:
    """ORB on one level; OpenCV allows two threads at a time."""

    def __init__(self, quota: int) -> None:
        self._quota, self._weakest = quota, 0
        self._orb = cv2.ORB.create(nfeatures=quota, nlevels=1, scoreType=cv2.ORB_FAST_SCORE)

    def detect(self, image: Image, threshold: int, *, full: Image) -> _Detected:
        """Return the strongest corners, as many as wanted, of those above a threshold.

        Their pixels are those of the `full` image, of which `image` is a level.

        Most images have many more: detection begins near the strength of the last image's weakest
        corner, and is repeated with a lower threshold if too few are found. This only saves time:
        the result is the same.
        """
        bold = round(_BOLDNESS * self._weakest)
        keypoints = self._detect(image, bold) if bold > threshold else ()
        if len(keypoints) < self._quota:
            keypoints = self._detect(image, threshold)
        strength = np.fromiter(map(attrgetter("response"), keypoints), np.int64, len(keypoints))
        self._weakest = int(strength.min()) if len(strength) else 0
        uv_px = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64).reshape(-1, 2)
        order = np.lexsort((uv_px @ _ROW_BY_ROW, -strength))
        # A pixel's centre has integer coordinates: those of a smaller image lie half a pixel off.
        scale = np.divide(full.shape[1::-1], image.shape[1::-1])
        uv_px = (uv_px.take(order, axis=0) + 0.5) * scale - 0.5
        columns, rows = (uv_px / _CELL_PX).astype(np.int64).T
        return _Detected(
            keypoints=[keypoints[row] for row in order.tolist()],
            uv_px=uv_px,
            cells=(rows << 10) + columns,
            strength=strength.take(order),
        )

    def describe(self, image: Image, keypoints: Sequence[cv2.KeyPoint]) -> NDArray[np.uint8]:
        """Return the descriptors (N, 32) of corners."""
        if not keypoints:
            return np.zeros((0, 32), np.uint8)
        return np.asarray(self._orb.compute(image, keypoints)[1])

    def _detect(self, image: Image, threshold: int) -> Sequence[cv2.KeyPoint]:
        self._orb.setFastThreshold(threshold)
        return self._orb.detect(image, None)


class CornerFinder:
    """Finds corners on all levels of an image, on half of them in a second thread."""

    def __init__(self, settings: RgbdSettings) -> None:
        self._settings = settings
        count, shares = settings.feature_count, SCALE ** -np.arange(LEVELS)
        quotas = np.rint(_SURPLUS * count * shares / shares.sum()).astype(int).tolist()
        self._octaves = [_Octave(quota) for quota in quotas]
        self._beside = thread_beside("rgbd-corners")

    def find(self, gray: Image) -> Corners:
        """Return the corners of a grey image (H, W) that are clearly above its noise."""
        shrunk = self._beside.submit(_pyramid, gray)
        threshold = self._threshold(gray)
        coming = self._beside.submit(lambda: self._detect(shrunk.result(), _BESIDE, threshold))
        found = self._detect([gray], _FIRST, threshold)
        pyramid = shrunk.result()
        found |= self._detect(pyramid, _REST, threshold) | coming.result()
        detected = [found[level] for level in range(LEVELS)]
        chosen = _spread(detected, self._settings.feature_count)
        described = self._beside.submit(self._describe, pyramid, detected, chosen, _BESIDE)
        parts = self._describe(pyramid, detected, chosen, _FIRST + _REST) | described.result()
        uv_px = [
            level.uv_px.take(rows, axis=0) for level, rows in zip(detected, chosen, strict=True)
        ]
        return Corners(
            uv_px=np.concatenate(uv_px),
            levels=np.repeat(np.arange(LEVELS), [len(rows) for rows in chosen]),
            descriptors=np.concatenate([parts[i] for i in range(LEVELS)]),
        )

    def _threshold(self, gray: Image) -> int:
        """Return the FAST threshold [grey levels]: a multiple of the noise, within limits."""
        threshold = self._settings.fast_noise_ratio * grey_noise(gray)
        return int(np.clip(threshold, self._settings.fast_threshold_min, _THRESHOLD_MAX))

    def _detect(
        self, pyramid: Sequence[Image], levels: Sequence[int], threshold: int
    ) -> dict[int, _Detected]:
        full = pyramid[0]
        return {i: self._octaves[i].detect(pyramid[i], threshold, full=full) for i in levels}

    def _describe(
        self,
        pyramid: Sequence[Image],
        detected: Sequence[_Detected],
        chosen: Sequence[NDArray[np.int64]],
        levels: Sequence[int],
    ) -> dict[int, NDArray[np.uint8]]:
        """Return the descriptors of the chosen rows of some levels."""
        return {
            i: self._octaves[i].describe(
                pyramid[i], [detected[i].keypoints[row] for row in chosen[i].tolist()]
            )
            for i in levels
        }


def _pyramid(gray: Image) -> list[Image]:
    """Return the image on all levels, bit by bit the same on every machine."""
    images = [gray]
    for level in range(1, LEVELS):
        height, width = (max(1, round(side / SCALE**level)) for side in gray.shape)
        smaller = cv2.resize(images[-1], (width, height), interpolation=cv2.INTER_LINEAR_EXACT)
        images.append(np.asarray(smaller, np.uint8))
    return images


def _spread(detected: Sequence[_Detected], count: int) -> list[NDArray[np.int64]]:
    """Return which `count` corners to keep, as rows of each level.

    Each cell's strongest corner first, then each cell's second, and so on; of equal corners the one
    on the finer level, then the first.
    """
    ends = np.cumsum([len(corners.strength) for corners in detected])
    cells = np.concatenate([corners.cells for corners in detected])
    rows = np.arange(len(cells))
    # Numbers to sort by: the row in the lowest bits, above it the strength, above it the cell.
    strength = np.concatenate([corners.strength for corners in detected])
    by_strength = (_STRONGEST - strength << _ROW_BITS) + rows
    by_cell = np.argsort((cells << _ROW_BITS + 8) + by_strength)
    is_first = np.diff(cells[by_cell], prepend=-1) != 0
    rank = rows - np.maximum.accumulate(np.where(is_first, rows, 0))
    best = np.argsort((rank << _ROW_BITS + 8) + by_strength[by_cell])[:count]
    chosen = np.sort(by_cell[best])
    starts = [0, *ends[:-1].tolist()]
    bounds = np.searchsorted(chosen, [*starts, len(cells)])
    return [chosen[bounds[i] : bounds[i + 1]] - starts[i] for i in range(LEVELS)]
