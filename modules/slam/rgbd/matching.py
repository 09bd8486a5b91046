"""Which landmark is which feature: by descriptor, near a predicted pixel or anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .features import Features

_MAX_HAMMING = 64
_MAX_HAMMING_ANYWHERE = 50
_RATIO_ANYWHERE = 0.75
_LEVEL_TOLERANCE = 1
_ROW_BITS = 32  # of a sort key that holds a distance above and a row below
_NO_RIVAL = 1 << 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Pairs of rows: of the landmarks asked for, and of the features."""

    landmark_rows: NDArray[np.int64]  # (N,)
    feature_rows: NDArray[np.int64]  # (N,), each at most once

    def __len__(self) -> int:
        return len(self.feature_rows)

    def only(self, mask: NDArray[np.bool_]) -> Matches:
        """Return the pairs where `mask` (N,) is true."""
        return Matches(landmark_rows=self.landmark_rows[mask], feature_rows=self.feature_rows[mask])


def match_near(
    uv_px: NDArray[np.float64],
    levels: NDArray[np.int64],
    descriptors: NDArray[np.uint8],
    features: Features,
    *,
    radius_px: float,
    ratio: float = 1.0,
) -> Matches:
    """Return the features that look like the landmarks expected within `radius_px` of them.

    `uv_px` (M, 2), `levels` (M,) and `descriptors` (M, 32) are the landmarks' predictions.
    """
    rows, candidates = _pairs_within(uv_px, features.uv_px, radius_px)
    near = np.abs(levels[rows] - features.levels[candidates]) <= _LEVEL_TOLERANCE
    return match_pairs(rows[near], candidates[near], descriptors, features.descriptors, ratio=ratio)


def match_pairs(
    rows: NDArray[np.int64],
    candidates: NDArray[np.int64],
    descriptors: NDArray[np.uint8],
    others: NDArray[np.uint8],
    *,
    ratio: float,
) -> Matches:
    """Return the pairs that look alike, of those given (P,): by rising row of `descriptors`."""
    if not len(rows):
        return _no_matches()
    words = descriptors.view(np.uint64).take(rows, axis=0)
    words ^= others.view(np.uint64).take(candidates, axis=0)
    distances = np.einsum("ij->i", np.bitwise_count(words), dtype=np.int64)
    return _clear_winners(rows, candidates, distances, ratio)


def match_anywhere(descriptors: NDArray[np.uint8], features: Features) -> Matches:
    """Return mutual best matches of descriptors (M, 32), wherever in the image they are."""
    if len(descriptors) < 2 or len(features) < 2:
        return _no_matches()
    distances, rows = cv2.batchDistance(
        features.descriptors, descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )[:2]
    best, second = distances[:, 0], distances[:, 1]
    clear = (best <= _MAX_HAMMING_ANYWHERE) & (best < _RATIO_ANYWHERE * second)
    feature_rows = np.flatnonzero(clear)
    return _one_to_one(
        rows[feature_rows, 0].astype(np.int64), feature_rows, best[feature_rows].astype(np.int64)
    )


def _pairs_within(
    uv_px: NDArray[np.float64], feature_uv_px: NDArray[np.float64], radius_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs (row of `uv_px`, feature) closer than the radius, by rising row.

    Features are sorted into cells of the radius's size: the candidates of a pixel are three
    runs of three neighbouring cells.
    """
    if not len(uv_px) or not len(feature_uv_px):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    lowest = np.minimum(uv_px.min(axis=0), feature_uv_px.min(axis=0)) - radius_px
    cells = ((uv_px - lowest) / radius_px).astype(np.int64)
    feature_cells = ((feature_uv_px - lowest) / radius_px).astype(np.int64)
    width, height = np.maximum(cells.max(axis=0), feature_cells.max(axis=0)) + 2
    flat = feature_cells[:, 1] * width + feature_cells[:, 0]
    order = np.argsort(flat, kind="stable")
    starts_of_cells = np.zeros(width * height + 1, np.int64)
    np.cumsum(np.bincount(flat, minlength=width * height), out=starts_of_cells[1:])
    middle = cells[:, 1:] * width + cells[:, :1] + width * np.array([[-1, 0, 1]])  # (M, 3)
    starts = starts_of_cells[middle - 1].ravel()
    counts = starts_of_cells[middle + 2].ravel() - starts
    rows = np.repeat(np.arange(len(uv_px)), counts.reshape(-1, 3).sum(axis=1))
    offsets = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    candidates = order[np.repeat(starts, counts) + offsets]
    apart = np.take(uv_px, rows, axis=0) - np.take(feature_uv_px, candidates, axis=0)
    near = np.einsum("ij,ij->i", apart, apart) <= radius_px**2
    return rows[near], candidates[near]


def _clear_winners(
    rows: NDArray[np.int64],
    candidates: NDArray[np.int64],
    distances: NDArray[np.int64],
    ratio: float,
) -> Matches:
    """Return each row's best candidate where it is near and clearly better than the next."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(rows) != 0]))
    lengths = np.diff(np.append(starts, len(rows)))
    keys = distances * (1 << _ROW_BITS) + np.arange(len(rows))  # unique, smallest distance first
    best = np.minimum.reduceat(keys, starts)
    keys_but_best = np.where(keys == np.repeat(best, lengths), _NO_RIVAL, keys)
    second = np.minimum.reduceat(keys_but_best, starts) >> _ROW_BITS
    pair, best = best & ((1 << _ROW_BITS) - 1), best >> _ROW_BITS
    clear = (best <= _MAX_HAMMING) & (best < ratio * second)
    return _one_to_one(rows[pair[clear]], candidates[pair[clear]], best[clear])


def _one_to_one(
    rows: NDArray[np.int64], feature_rows: NDArray[np.int64], distances: NDArray[np.int64]
) -> Matches:
    """Return the pairs, the nearest only where a feature or landmark is claimed twice."""
    order = np.argsort(distances, kind="stable")
    order = order[np.unique(feature_rows[order], return_index=True)[1]]
    order = order[np.argsort(distances[order], kind="stable")]
    order = order[np.unique(rows[order], return_index=True)[1]]
    return Matches(landmark_rows=rows[order], feature_rows=feature_rows[order])


def _no_matches() -> Matches:
    return Matches(landmark_rows=np.zeros(0, np.int64), feature_rows=np.zeros(0, np.int64))
