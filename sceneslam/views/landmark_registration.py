"""The motion between two views by the landmarks of both, whatever cameras saw them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.views.matching import matches
from sceneslam.views.placed_views import (
    FLOOR,
    MATCHES_MIN,
    PRECISE_M,
    SIGMAS,
    PlacedViews,
    Sighting,
)
from sceneslam.views.view import Landmarks

_SAMPLES = 300  # of three matches each: one is right with 99.9 % if three of ten matches are
_ROUNDS = 3  # of the motion by all matches that are right: which ones are depends on it


def recognize(
    known: PlacedViews, landmarks: Landmarks, among: Sequence[int] | None = None
) -> tuple[int, Sighting] | None:
    """Return which view of a map shows the same place, and where another one was taken.

    None if it shows no place of the views `among` them (None: all), or two alike.
    """
    return known.recognize(
        landmarks.descriptors, lambda number: register(*known[number], landmarks), among
    )


def register(T_map_first: Transform, first: Landmarks, second: Landmarks) -> Sighting | None:
    """Return where the second view was taken in the map of the first, None if too few agree."""
    rows, columns = matches(first.descriptors, second.descriptors)
    sigma_m = np.maximum(first.deviation_m[rows], second.deviation_m[columns]).astype(float)
    is_precise = sigma_m <= PRECISE_M
    if is_precise.sum() < MATCHES_MIN:
        return None
    rows, columns, sigma_m = rows[is_precise], columns[is_precise], sigma_m[is_precise]
    a, b = first.points_cam[rows].astype(float), second.points_cam[columns].astype(float)
    triples = np.random.default_rng(0).integers(0, len(a), (_SAMPLES, 3))
    tried = _rigid(a[triples], b[triples])
    counts = [np.sum(_off_m(T, a, b) <= SIGMAS * sigma_m) for T in tried]
    T = tried[int(np.argmax(counts))]
    for _ in range(_ROUNDS):
        kept = _off_m(T, a, b) <= SIGMAS * sigma_m
        if kept.sum() < MATCHES_MIN:
            return None
        T = _rigid(a[kept][None], b[kept][None])[0]
    by_motion = np.concatenate([np.tile(np.eye(3), (kept.sum(), 1, 1)), -se3.hat(b[kept])], axis=2)
    weighted = by_motion / sigma_m[kept, None, None]
    covariance = np.linalg.inv(np.einsum("nki,nkj->ij", weighted, weighted)) + FLOOR
    found = Sighting(T_map_cam=T_map_first @ T, covariance=covariance, matches=int(kept.sum()))
    return found if found.is_certain else None


def _rigid(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T_a_b (K, 4, 4) of K sets of points (K, N, 3) (Umeyama, PAMI 1991, without scale)."""
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(a - mean_a, 1, 2) @ (b - mean_b))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    turn = u @ vt
    shift = mean_a[:, 0] - np.einsum("kij,kj->ki", turn, mean_b[:, 0])
    return se3.from_parts(turn, shift)


def _off_m(T_a_b: Transform, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(se3.apply(T_a_b, b) - a, axis=1))
