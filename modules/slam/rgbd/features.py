"""Features of one image: ORB corners spread over it, undistorted, with their depth."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from operator import attrgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera

from .alignment import Alignment

LEVELS = 8
SCALE = 1.2  # between two levels of the pyramid
_COARSE = 2  # levels from this one on are a second thread's: half of the pixels
_CELL_PX = 40  # side of the cells that share out the features
_SURPLUS = 2  # corners detected per corner kept
_FAST_THRESHOLD_MAX = 20  # ORB's own default, right for a bright and clean image
_DEPTH_REACH_PX = 2  # of a corner, that should lie on the same surface
_DEPTH_SPREAD_RATIO = 0.03  # neighbours further apart than this lie across an edge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """What is recognisable in one image."""

    uv_px: NDArray[np.float64]  # (N, 2), without distortion
    levels: NDArray[np.int64]  # (N,), of the pyramid
    descriptors: NDArray[np.uint8]  # (N, 32)
    depth_m: NDArray[np.float64]  # (N,), along the optical axis, 0 = missing
    depth_slope_m_per_px: NDArray[np.float64]  # (N,), how steeply it changes around there

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def deep_count(self) -> int:
        """Return how many features have a depth."""
        return int(np.count_nonzero(self.depth_m))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Corners:
    """Corners of some levels, before they are shared out."""

    image: NDArray[np.uint8]  # of the first of these levels
    keypoints: Sequence[cv2.KeyPoint]  # (N,), in pixels of that image
    uv_px: NDArray[np.float64]  # (N, 2), in those of the whole image
    strength: NDArray[np.float64]  # (N,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Described:
    """Corners that were chosen."""

    uv_px: NDArray[np.float64]  # (N, 2), in pixels of the whole image
    levels: NDArray[np.int64]  # (N,)
    descriptors: NDArray[np.uint8]  # (N, 32)


class _Octaves:
    """ORB on some levels of the pyramid; OpenCV lets two threads do so at a time."""

    def __init__(self, first: int, levels: int, count: int) -> None:
        self._first, self._scale = first, SCALE**first
        self._orb = cv2.ORB.create(
            nfeatures=count, scaleFactor=SCALE, nlevels=levels, scoreType=cv2.ORB_FAST_SCORE
        )

    def detect(self, gray: NDArray[np.uint8], threshold: int) -> _Corners:
        """Return the strongest corners of these levels of an image."""
        height, width = (round(side / self._scale) for side in gray.shape)
        image = np.asarray(
            cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), np.uint8
        )
        self._orb.setFastThreshold(threshold)
        keypoints = self._orb.detect(image, None)
        strength = np.fromiter(map(attrgetter("response"), keypoints), np.float64, len(keypoints))
        return _Corners(
            image=image,
            keypoints=keypoints,
            uv_px=self._scale * _places(keypoints),
            strength=strength,
        )

    def describe(self, corners: _Corners, rows: NDArray[np.int64]) -> _Described:
        """Return some of the corners, by rising level, with descriptors."""
        chosen = [corners.keypoints[row] for row in rows.tolist()]
        keypoints, descriptors = self._orb.compute(corners.image, chosen)
        levels = np.fromiter(map(attrgetter("octave"), keypoints), np.int64, len(keypoints))
        return _Described(
            uv_px=self._scale * _places(keypoints),
            levels=self._first + levels,
            descriptors=np.asarray(descriptors if len(keypoints) else np.zeros((0, 32)), np.uint8),
        )


class FeatureExtractor:
    """Finds features where the image holds structure above its own noise."""

    def __init__(
        self,
        depth_camera: Camera,
        alignment: Alignment,
        *,
        count: int,
        fast_threshold_min: int,
        fast_noise_ratio: float,
    ) -> None:
        self._depth_camera, self._alignment = depth_camera, alignment
        self._camera, self._count = alignment.color_camera(depth_camera), count
        self._threshold_min, self._noise_ratio = fast_threshold_min, fast_noise_ratio
        fine_count = round(_SURPLUS * count * _share_of(_COARSE) / _share_of(LEVELS))
        self._fine = _Octaves(0, _COARSE, fine_count)
        self._coarse = _Octaves(_COARSE, LEVELS - _COARSE, _SURPLUS * count - fine_count)
        self._beside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="rgbd-features")

    def extract(self, gray: NDArray[np.uint8], depth_m: NDArray[np.float32] | None) -> Features:
        """Return the features of `gray` (H, W); without a depth image all depths are missing."""
        threshold = self.fast_threshold(gray)
        coming = self._beside.submit(self._coarse.detect, gray, threshold)
        fine, coarse = self._fine.detect(gray, threshold), coming.result()
        chosen = _spread(
            np.concatenate([fine.uv_px, coarse.uv_px]),
            np.concatenate([fine.strength, coarse.strength]),
            self._count,
        )
        count = len(fine.strength)
        described = self._beside.submit(
            self._coarse.describe, coarse, chosen[chosen >= count] - count
        )
        parts = [self._fine.describe(fine, chosen[chosen < count]), described.result()]
        uv_image = np.concatenate([part.uv_px for part in parts])
        uv_px = self._undistort(uv_image)
        depths_m, slopes = self._depths(self._in_depth(uv_image, uv_px, depth_m), depth_m)
        return Features(
            uv_px=uv_px,
            levels=np.concatenate([part.levels for part in parts]),
            descriptors=np.concatenate([part.descriptors for part in parts]),
            depth_m=depths_m,
            depth_slope_m_per_px=slopes,
        )

    def fast_threshold(self, gray: NDArray[np.uint8]) -> int:
        """Return the grey step that makes a corner: a multiple of the noise, within limits.

        The noise is the median response of a Laplacian, whose gain on white noise is sqrt(20).
        """
        response = np.abs(cv2.Laplacian(gray, cv2.CV_16S)[::4, ::4])
        noise = float(np.median(response)) / 0.6745 / np.sqrt(20.0)
        return int(np.clip(self._noise_ratio * noise, self._threshold_min, _FAST_THRESHOLD_MAX))

    def _undistort(self, uv_image: NDArray[np.float64]) -> NDArray[np.float64]:
        if not (len(uv_image) and any(self._camera.distortion)):
            return uv_image
        K, distortion = self._camera.K, np.array(self._camera.distortion)
        return np.asarray(cv2.undistortPoints(uv_image[:, None], K, distortion, P=K)[:, 0])

    def _in_depth(
        self,
        uv_image: NDArray[np.float64],
        uv_px: NDArray[np.float64],
        depth_m: NDArray[np.float32] | None,
    ) -> NDArray[np.float64]:
        """Return where the depth image shows the corners."""
        if depth_m is None or self._alignment.is_registered:
            return uv_image
        images = np.zeros(len(uv_px), np.int64)
        return self._alignment.find(self._depth_camera, uv_px, depth_m[None], images)

    def _depths(
        self, uv_image: NDArray[np.float64], depth_m: NDArray[np.float32] | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the depth at each corner, and its slope [m/px].

        At depth edges, where it may be either, it is missing.
        """
        if depth_m is None:
            return np.zeros(len(uv_image)), np.zeros(len(uv_image))
        height, width = depth_m.shape
        column, row = np.rint(uv_image).astype(np.int64).T
        columns = np.clip(
            column + _DEPTH_REACH_PX * np.array([[0], [-1], [1], [0], [0]]), 0, width - 1
        )
        rows = np.clip(row + _DEPTH_REACH_PX * np.array([[0], [0], [0], [-1], [1]]), 0, height - 1)
        depths = depth_m[rows, columns].astype(np.float64)  # (5, N), the corner's own first
        low_m, high_m = self._camera.depth_range_m
        usable = (depths >= low_m) & (depths <= high_m)  # False for NaN
        depth = np.where(usable[0], depths[0], 0.0)
        step = np.where(usable, np.abs(depths - depth), 0.0).max(axis=0)
        is_smooth = step <= _DEPTH_SPREAD_RATIO * depth * np.maximum(depth, 1.0)
        return np.where(is_smooth, depth, 0.0), step / _DEPTH_REACH_PX


def _share_of(levels: int) -> float:
    """Return how many corners the first levels have, those of level 0 counted as one."""
    return (1.0 - SCALE**-levels) / (1.0 - 1.0 / SCALE)


def _places(keypoints: Sequence[cv2.KeyPoint]) -> NDArray[np.float64]:
    return np.asarray(cv2.KeyPoint.convert(keypoints), np.float64).reshape(-1, 2)


def _spread(
    uv_px: NDArray[np.float64], strength: NDArray[np.float64], count: int
) -> NDArray[np.int64]:
    """Return `count` of the corners: every cell's best first, then every cell's second, and on."""
    if len(uv_px) <= count:
        return np.arange(len(uv_px))
    cells = (uv_px // _CELL_PX).astype(np.int64) @ np.array([1, 10_000])
    order = np.lexsort((-strength, cells))
    first = np.concatenate([[True], np.diff(cells[order]) != 0])
    starts = np.flatnonzero(first)
    rank = np.arange(len(order)) - starts[np.cumsum(first) - 1]
    return np.asarray(order[np.lexsort((-strength[order], rank))[:count]])
