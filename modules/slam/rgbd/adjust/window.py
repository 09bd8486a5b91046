"""The window of the map that is adjusted at a time: copied, and merged back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform

from ..locate.residuals import Sightings
from ..map.keyframes import NO_LANDMARK
from ..map.visual_map import VisualMap
from ..see.alignment_search import Shown
from .bundle import Adjusted, Bundle
from .mapping_work import Task
from .odometry_constraints import odometry_constraints
from .pose_constraints import PoseConstraints

_FREE = 5
_HELD = 15
_MAX_SIGMA_M, _MAX_SIGMA_RATIO = 1.0, 1.0  # limits of a landmark; the second of its distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapWindow:
    """A copied part of the map to adjust, with its origin in the map."""

    task: Task
    landmark_ids: NDArray[np.int64]  # (L,), ascending
    births: NDArray[np.int64]  # (L,), to distinguish a landmark from a later one of the same id
    feature_rows: NDArray[np.int64]  # (N,), of each sighting in its keyframe
    corrections: int  # of the map, when it was copied


def take_window(
    visual_map: VisualMap, keyframe_id: int, fresh: Mapping[int, Shown]
) -> MapWindow | None:
    """Return a copy of a keyframe's surroundings: landmarks that two or more keyframes saw.

    `fresh`: views of new keyframes, by id. None if it shares no landmark with another keyframe.
    """
    store = visual_map.keyframes
    free = store.covisible(store.landmarks_of([keyframe_id]), limit=_FREE)
    seen_ids = store.landmarks_of(free)
    held = [k for k in store.covisible(seen_ids, limit=_FREE + _HELD) if k not in free]
    if not held:
        held = [min(free, default=keyframe_id)]
    if not {*free} - {*held}:
        return None
    keyframe_ids = sorted({*free, *held})
    keyframes = [store[k] for k in keyframe_ids]
    ids = np.concatenate([k.landmark_ids for k in keyframes])
    of_keyframe = np.repeat(np.arange(len(keyframes)), [len(k.landmark_ids) for k in keyframes])
    of_feature = np.concatenate([np.arange(len(k.landmark_ids)) for k in keyframes])
    candidates = np.flatnonzero(np.isin(ids, seen_ids))
    _, where, counts = np.unique(ids[candidates], return_inverse=True, return_counts=True)
    chosen = candidates[counts[where] > 1]
    landmark_ids, landmark_rows = np.unique(ids[chosen], return_inverse=True)
    features = [k.features for k in keyframes]
    levels = np.concatenate([f.levels for f in features])[chosen]
    bundle = Bundle(
        T_local_cam=np.stack([k.T_local_base for k in keyframes]) @ visual_map.camera.T_base_cam,
        is_free=np.array([k not in held for k in keyframe_ids]),
        points_local=visual_map.landmarks.points_local[landmark_ids],
        keyframe_rows=of_keyframe[chosen],
        landmark_rows=landmark_rows,
        seen=Sightings(
            uv_px=np.concatenate([f.uv_px for f in features])[chosen],
            sigma_px=visual_map.sigma_px(levels),
            depth_m=np.concatenate([f.depth_m for f in features])[chosen],
            inverse_depth_sigma_per_m=np.concatenate(
                [visual_map.inverse_depth_sigmas_per_m(f) for f in features]
            )[chosen],
        ),
        constraints=PoseConstraints.of([]),
    )
    task = Task(
        bundle=bundle,
        keyframe_ids=keyframe_ids,
        free_ids=free,
        map_ids=frozenset(store.ids),
        fresh=fresh,
        by_odometry=odometry_constraints(
            dict(zip(keyframe_ids, keyframes, strict=True)), visual_map.camera.T_base_cam
        ),
    )
    return MapWindow(
        task=task,
        landmark_ids=landmark_ids,
        births=visual_map.landmarks.births[landmark_ids],
        feature_rows=of_feature[chosen],
        corrections=visual_map.corrections,
    )


def merge_window(visual_map: VisualMap, window: MapWindow, adjusted: Adjusted) -> Transform:
    """Apply the adjusted keyframes and landmarks to the map; remove wrong sightings.

    Returns T_new_old (4, 4) of the window's newest keyframe, with which all newer ones move. A map
    that was corrected after the copy was taken does not change.
    """
    store, table = visual_map.keyframes, visual_map.landmarks
    newest = window.task.keyframe_ids[-1]
    if window.corrections != visual_map.corrections or newest not in store.ids:
        return se3.identity()
    T_local_base = adjusted.bundle.T_local_cam @ se3.inverse(visual_map.camera.T_base_cam)
    poses = dict(zip(window.task.keyframe_ids, T_local_base, strict=True))
    T_new_old = poses[newest] @ se3.inverse(store[newest].T_local_base)
    newer = {k: T_new_old @ store[k].T_local_base for k in store.ids if k > newest}
    visual_map.correct({k: T for k, T in (poses | newer).items() if k in store.ids})
    same = table.alive[window.landmark_ids] & (table.births[window.landmark_ids] == window.births)
    away = adjusted.bundle.points_local - T_local_base[-1, :3, 3]
    most_m = np.maximum(_MAX_SIGMA_M, _MAX_SIGMA_RATIO * np.linalg.norm(away, axis=1))
    located = np.linalg.eigvalsh(adjusted.information)[:, 0] > most_m**-2
    known = same & located
    table.settle(
        window.landmark_ids[known],
        points_local=adjusted.bundle.points_local[known],
        information=adjusted.information[known],
    )
    _forget(visual_map, window, adjusted)
    visual_map.drop(window.landmark_ids[same & ~located])
    return np.asarray(T_new_old)


def _forget(visual_map: VisualMap, window: MapWindow, adjusted: Adjusted) -> None:
    """Remove disagreeing sightings from their keyframes."""
    store = visual_map.keyframes
    for row, keyframe_id in enumerate(window.task.keyframe_ids):
        wrong = ~adjusted.agrees & (adjusted.bundle.keyframe_rows == row)
        if keyframe_id in store.ids:
            ids = store[keyframe_id].landmark_ids
            rows = window.feature_rows[wrong]
            landmark_ids = window.landmark_ids[adjusted.bundle.landmark_rows[wrong]]
            ids[rows[ids[rows] == landmark_ids]] = NO_LANDMARK
