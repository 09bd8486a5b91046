"""Join duplicate landmarks after a loop closure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..locate.matching import match_near
from ..map.keyframes import NO_LANDMARK
from ..map.visual_map import VisualMap

_RADIUS_PX = 6.0  # around the projection of an old landmark in a new keyframe
_MOST = 10  # keyframes on the new side


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


def _fuse_into(visual_map: VisualMap, keyframe_id: int, old_ids: NDArray[np.int64]) -> None:
    keyframe = visual_map.keyframes[keyframe_id]
    wanted = np.setdiff1d(old_ids, keyframe.landmark_ids)
    prediction = visual_map.predict(keyframe.T_local_base, wanted)
    matches = match_near(prediction, keyframe.features, radius_px=_RADIUS_PX)
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
