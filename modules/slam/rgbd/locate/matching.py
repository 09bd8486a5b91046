"""Match landmarks to features by descriptor, near a predicted pixel or anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..map.visual_map import ExpectedLandmarks
from ..see.features import Features

_MAX_HAMMING = 64
_MAX_HAMMING_ANYWHERE = 50
_RATIO_ANYWHERE = 0.75
_LEVEL_TOLERANCE = 1
_CELLS_PER_RADIUS = 4  # along a row of the image
_ROW_BITS = 32  # of a sort key that holds a distance above and a row below
_ROW_MASK = (1 << _ROW_BITS) - 1
_NO_RIVAL = 1 << 60


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Pairs of rows: of the queried landmarks, and of the features."""

    landmark_rows: NDArray[np.int64]  # (N,)
    feature_rows: NDArray[np.int64]  # (N,), each at most once

    def __len__(self) -> int:
        return len(self.feature_rows)

    def only(self, mask: NDArray[np.bool_]) -> Matches:
        """Return the pairs where `mask` (N,) is true."""
        return Matches(landmark_rows=self.landmark_rows[mask], feature_rows=self.feature_rows[mask])


def match_near(
    expected: ExpectedLandmarks, features: Features, *, radius_px: float, ratio: float = 1.0
) -> Matches:
    """Return the matches of landmarks to features within `radius_px` of the predicted pixels."""
    if not len(expected.ids) or not len(features):
        return _no_matches()
    rows, candidates = _pairs_within(expected.uv_px, features.uv_px, radius_px)
    apart = expected.levels.take(rows) - features.levels.take(candidates)
    near = np.flatnonzero(np.abs(apart) <= _LEVEL_TOLERANCE)
    rows, candidates = rows.take(near), candidates.take(near)
    descriptors = expected.descriptors
    return match_pairs(rows, candidates, descriptors, features.descriptors, ratio=ratio)


def match_pairs(
    rows: NDArray[np.int64],
    candidates: NDArray[np.int64],
    descriptors: NDArray[np.uint8],
    others: NDArray[np.uint8],
    *,
    ratio: float,
) -> Matches:
    """Return the matches among given pairs (P,), which are ordered by row of `descriptors`."""
    if not len(rows):
        return _no_matches()
    words = descriptors.view(np.uint64).take(rows, axis=0)
    words ^= others.view(np.uint64).take(candidates, axis=0)
    distances = np.einsum("ij->i", np.bitwise_count(words), dtype=np.int64)
    return _clear_winners(rows, candidates, distances, ratio)


def match_anywhere(descriptors: NDArray[np.uint8], features: Features) -> Matches:
    """Return mutual best matches of descriptors (M, 32), anywhere in the image."""
    if len(descriptors) < 2 or len(features) < 2:
        return _no_matches()
    distances, rows = cv2.batchDistance(
        features.descriptors, descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2
    )[:2]
    best, second = distances.astype(np.int64).T
    clear = np.flatnonzero((best <= _MAX_HAMMING_ANYWHERE) & (best < _RATIO_ANYWHERE * second))
    claims = rows[:, 0].take(clear).astype(np.int64)
    kept = _first_claims(claims, best.take(clear))
    kept = kept.take(np.argsort(claims.take(kept)))
    return Matches(landmark_rows=claims.take(kept), feature_rows=clear.take(kept))


def _pairs_within(
    uv_px: NDArray[np.float64], feature_uv_px: NDArray[np.float64], radius_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs (row of `uv_px`, feature) closer than the radius, by rising row.

    Features are sorted into cells as high as the radius and a fraction as wide: the candidates of
    a pixel are one run of neighbouring cells in each of three rows.
    """
    # Component by component: NumPy is slow along axes of two.
    ask, have = uv_px.T.copy(), feature_uv_px.T.copy()
    lowest = np.minimum(ask.min(axis=1), have.min(axis=1))[:, None] - radius_px
    per_px = np.array([[_CELLS_PER_RADIUS], [1.0]]) / radius_px
    columns, rows = ((ask - lowest) * per_px).astype(np.int64)
    feature_columns, feature_rows = ((have - lowest) * per_px).astype(np.int64)
    width = max(columns.max(), feature_columns.max()) + _CELLS_PER_RADIUS + 1
    flat = feature_rows * width + feature_columns
    order = np.argsort(flat, kind="stable")
    starts_of_cells = np.zeros((max(rows.max(), feature_rows.max()) + 2) * width + 1, np.int64)
    np.cumsum(np.bincount(flat, minlength=len(starts_of_cells) - 1), out=starts_of_cells[1:])
    middle = ((rows * width + columns)[:, None] + width * np.array([-1, 0, 1])).ravel()  # (3 M,)
    starts = starts_of_cells.take(middle - _CELLS_PER_RADIUS)
    counts = starts_of_cells.take(middle + _CELLS_PER_RADIUS + 1) - starts
    ends = np.cumsum(counts)
    candidates = order.take(np.arange(ends[-1]) + np.repeat(starts - ends + counts, counts))
    rows = np.repeat(np.arange(len(uv_px)), np.diff(ends[2::3], prepend=0))
    apart_u = ask[0].take(rows) - have[0].take(candidates)
    apart_v = ask[1].take(rows) - have[1].take(candidates)
    near = np.flatnonzero(apart_u * apart_u + apart_v * apart_v <= radius_px**2)
    return rows.take(near), candidates.take(near)


def _clear_winners(
    rows: NDArray[np.int64],
    candidates: NDArray[np.int64],
    distances: NDArray[np.int64],
    ratio: float,
) -> Matches:
    """Return each row's best candidate if it is close enough and clearly better than the next."""
    starts = np.flatnonzero(np.diff(rows, prepend=-1))
    keys = _keys(distances)
    best = np.minimum.reduceat(keys, starts)
    pair, best = best & _ROW_MASK, best >> _ROW_BITS
    keys[pair] = _NO_RIVAL
    second = np.minimum.reduceat(keys, starts) >> _ROW_BITS
    clear = np.flatnonzero((best <= _MAX_HAMMING) & (best < ratio * second))
    pair = pair.take(clear)
    pair = pair.take(_first_claims(candidates.take(pair), best.take(clear)))
    return Matches(landmark_rows=rows.take(pair), feature_rows=candidates.take(pair))


def _first_claims(claims: NDArray[np.int64], distances: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, ascending, the row with the smallest distance for each claimed feature."""
    keys = _keys(distances)
    nearest = np.full(claims.max(initial=0) + 1, _NO_RIVAL)
    np.minimum.at(nearest, claims, keys)
    return np.flatnonzero(nearest.take(claims) == keys)


def _keys(distances: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return sort keys (N,): by distance (N,), equal distances by row."""
    return (distances << _ROW_BITS) + np.arange(len(distances))


def _no_matches() -> Matches:
    return Matches(landmark_rows=np.zeros(0, np.int64), feature_rows=np.zeros(0, np.int64))
