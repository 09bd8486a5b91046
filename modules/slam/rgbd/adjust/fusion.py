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
_LOOP_RADIUS_PX = 6.0  # around the projection of an old landmark in a new keyframe
_MOST = 10  # keyframes on the new side of a loop


def join_duplicates(
    visual_map: VisualMap, keyframe: Keyframe, segment: Iterable[int] | None
) -> None:
    """Join landmarks that project to features of the keyframe with similar descriptors.

    `segment` are the keyframes whose landmarks these may be, None: all.
    """
    table, keyframes = visual_map.landmarks, visual_map.keyframes
    ids = np.flatnonzero(table.alive) if segment is None else keyframes.landmarks_of(segment)
    others = np.setdiff1d(ids, keyframe.landmark_ids)
    expected = visual_map.predict(keyframe.T_local_base, others)
    matches = match_near(expected, keyframe.features, radius_px=_RADIUS_PX, ratio=_RATIO)
    matches = matches.only(_are_many(table.births[expected.ids], matches.landmark_rows))
    here, there = keyframe.landmark_ids[matches.feature_rows], expected.ids[matches.landmark_rows]
    known = here != NO_LANDMARK
    here, there = here[known], there[known]
    older = table.births[there] < table.births[here]
    keep, drop = np.where(older, there, here), np.where(older, here, there)
    same = _are_near(visual_map, keep, drop) & ~keyframes.show_both(keep, drop)
    visual_map.join(keep[same], drop[same])


def fuse_duplicates(visual_map: VisualMap, *, old: int, new: int) -> None:
    """Assign the landmarks around `old` to the features around `new` that show them.

    Both are keyframe ids; the map has just been corrected, so that the landmarks project close to
    these features.
    """
    keyframes = visual_map.keyframes
    old_side = keyframes.covisible(keyframes[old].landmark_ids, limit=_MOST)
    new_side = keyframes.covisible(keyframes[new].landmark_ids, limit=_MOST)
    for keyframe_id in new_side:
        if keyframe_id not in old_side:
            _fuse_into(visual_map, keyframe_id, keyframes.landmarks_of(old_side))


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


def _fuse_into(visual_map: VisualMap, keyframe_id: int, old_ids: NDArray[np.int64]) -> None:
    keyframe = visual_map.keyframes[keyframe_id]
    wanted = np.setdiff1d(old_ids, keyframe.landmark_ids)
    prediction = visual_map.predict(keyframe.T_local_base, wanted)
    matches = match_near(prediction, keyframe.features, radius_px=_LOOP_RADIUS_PX)
    matches = matches.only(~np.isin(keyframe.landmark_ids[matches.feature_rows], old_ids))
    kept = prediction.ids[matches.landmark_rows]
    doubles = keyframe.landmark_ids[matches.feature_rows]
    is_double = doubles != NO_LANDMARK
    keyframe.landmark_ids[matches.feature_rows[~is_double]] = kept[~is_double]
    kept, doubles = kept[is_double], doubles[is_double]
    is_one = ~visual_map.keyframes.show_both(kept, doubles)
    _unite(visual_map, kept[is_one], doubles[is_one])


def _unite(visual_map: VisualMap, kept: NDArray[np.int64], doubles: NDArray[np.int64]) -> None:
    """Merge the measurements of duplicates (N,) into the landmarks that are kept (N,)."""
    table = visual_map.landmarks
    scale_sigma = np.minimum(table.scale_sigma[kept], table.scale_sigma[doubles])
    table.fuse(
        kept, points_local=table.points_local[doubles], information=table.information[doubles]
    )
    table.scale_sigma[kept] = scale_sigma  # without depth neither of them measured it
    table.expected[kept] += table.expected[doubles]
    table.found[kept] += table.found[doubles]
    visual_map.join(kept, doubles)
