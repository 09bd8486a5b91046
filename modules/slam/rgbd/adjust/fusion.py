"""Join duplicate landmarks: points that were mapped again when they were seen again."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..locate.matching import match_near
from ..map.keyframes import NO_LANDMARK, Keyframe
from ..map.visual_map import VisualMap

_RADIUS_PX = 25.0
_RATIO = 0.85
_MIN_FOUND = 8  # landmarks of one group (mapped together), at least
_MIN_FOUND_RATIO = 0.2
_MAX_GAP_M = 0.1  # largest distance of two duplicates


def join_duplicates(
    visual_map: VisualMap, keyframe: Keyframe, segment: Iterable[int] | None
) -> None:
    """Join landmarks that project to features of the keyframe with similar descriptors.

    `segment` are the keyframes whose landmarks these may be, None: all.
    """
    table = visual_map.landmarks
    others = table.alive.copy()
    if segment is not None:
        others[:] = False
        others[visual_map.keyframes.landmarks_of(segment)] = True
    others[keyframe.landmark_ids[keyframe.landmark_ids != NO_LANDMARK]] = False
    expected = visual_map.predict(keyframe.T_local_base, np.flatnonzero(others))
    matches = match_near(expected, keyframe.features, radius_px=_RADIUS_PX, ratio=_RATIO)
    matches = matches.only(_are_many(table.births[expected.ids], matches.landmark_rows))
    here, there = keyframe.landmark_ids[matches.feature_rows], expected.ids[matches.landmark_rows]
    known = here != NO_LANDMARK
    here, there = here[known], there[known]
    older = table.births[there] < table.births[here]
    keep, drop = np.where(older, there, here), np.where(older, here, there)
    same = _are_near(visual_map, keep, drop) & ~visual_map.keyframes.show_both(keep, drop)
    visual_map.join(keep[same], drop[same])


def _are_many(groups: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return for the rows found (N,) whether enough landmarks of their group were found.

    Few matches are chance, or a part of the map with drift, which loop closure corrects.
    """
    size = int(groups.max(initial=0)) + 1
    expected, found = np.bincount(groups, minlength=size), np.bincount(groups[rows], minlength=size)
    are_many = (found >= _MIN_FOUND) & (found >= _MIN_FOUND_RATIO * expected)
    return np.asarray(are_many[groups[rows]])


def _are_near(
    visual_map: VisualMap, some: NDArray[np.int64], others: NDArray[np.int64]
) -> NDArray[np.bool_]:
    table = visual_map.landmarks
    gaps_m = table.points_local[some] - table.points_local[others]
    return np.asarray(np.linalg.norm(gaps_m, axis=1) < _MAX_GAP_M)
