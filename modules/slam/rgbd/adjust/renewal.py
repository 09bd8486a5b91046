"""Rebuild the map from its views after depth was found not to be registered."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from ..map.keyframes import KeyframeStore
from ..parts import RgbdParts
from ..see.view import View

NEWEST = -1  # id of the newest view, which may not be a keyframe


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocatedView:
    """A view with its pose in the old map."""

    view: View
    T_local_base: Transform


def seen_by(
    keyframes: KeyframeStore,
    views: Mapping[int, View],
    segment: Collection[int] | None,
    newest: LocatedView,
) -> dict[int, LocatedView]:
    """Return the views of a segment's keyframes (None: all) by id, and the newest view last.

    Only keyframes with a stored view that are older than the newest view.
    """
    now_ns = newest.view.observation.stamp_ns
    seen = {
        k: LocatedView(view=views[k], T_local_base=keyframes[k].T_local_base)
        for k in keyframes.ids
        if k in views and keyframes[k].stamp_ns < now_ns and (segment is None or k in segment)
    }
    return seen | {NEWEST: newest}


def renew(parts: RgbdParts, seen: Mapping[int, LocatedView]) -> dict[int, Transform]:
    """Insert a keyframe for each view in this order; return T_local_base by id.

    The first keeps its pose; the others are localized relative to those before them. If that fails,
    the motion from the last one in the old map is used.
    """
    T_new_old, held_ids, poses = se3.identity(), np.zeros(0, np.int64), dict[int, Transform]()
    for keyframe_id, old in seen.items():
        view = parts.eye.look(
            old.view.observation,
            old.view.image_bgr,
            T_predicted=np.asarray(T_new_old @ old.T_local_base),
            rate_base=parts.map.camera.T_base_cam[:3, :3] @ old.view.turning.rate_cam,
            odometry=old.view.odometry,
        )
        fix = parts.search.find(view, held_ids, is_lost=False) if poses else None
        T_local_base = view.T_predicted if fix is None else fix.estimate.T_local_base
        segment = None if poses else set[int]()
        held_ids = parts.insert(view, T_local_base, segment, fix=fix)
        poses[keyframe_id] = T_local_base
        T_new_old = T_local_base @ se3.inverse(old.T_local_base)
    return poses
