"""Make a keyframe of a view, and pass it to all parts that use keyframes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.se3 import Transform

from ..adjust.fusion import join_duplicates
from ..adjust.local_mapping import LocalMapping
from ..adjust.triangulation import triangulate
from ..locate.localizer import VisualFix
from ..see.view import View
from .keyframes import NO_LANDMARK, Keyframe
from .layers import LayerBuilder
from .map_history import MapHistory
from .visual_map import VisualMap


class KeyframeMaker:
    """Extends the map by a view."""

    def __init__(
        self, visual_map: VisualMap, layers: LayerBuilder, memory: MapHistory, mapping: LocalMapping
    ) -> None:
        self._map, self._layers = visual_map, layers
        self._memory, self._mapping = memory, mapping

    def insert(
        self,
        view: View,
        T_local_base: Transform,
        segment: set[int] | None,
        *,
        fix: VisualFix | None,
        guessed_s: float | None,
    ) -> NDArray[np.int64]:
        """Insert a keyframe at a pose (4, 4) and return the ids (N,) of its landmarks.

        `segment`: the keyframes whose landmarks these may be, None: all. `fix`: the pose found in
        the map, None for odometry. `guessed_s`: time without a pose if the pose is a guess.
        """
        landmark_ids = np.full(len(view.features), NO_LANDMARK)
        if fix is not None:
            landmark_ids[fix.feature_rows] = fix.landmark_ids
        stamp_ns = view.observation.stamp_ns
        keyframe = Keyframe(
            stamp_ns=stamp_ns,
            T_local_base=T_local_base.copy(),
            features=view.features,
            landmark_ids=landmark_ids,
            view=self._layers.view(view.depth_m, view.image_bgr, stamp_ns=stamp_ns),
            turning=view.turning,
            is_monocular=view.is_monocular,
            odometry=view.odometry,
        )
        deep_rows = landmark_ids[:0] if fix is None else fix.deep_rows
        keyframe_id = self._map.insert(keyframe, deep_rows=deep_rows)
        triangulate(self._map, keyframe_id)
        join_duplicates(self._map, keyframe, segment)
        self._memory.insert(fix, view.depth_m, guessed_s=guessed_s)
        self._mapping.insert(keyframe_id, view)
        return np.asarray(landmark_ids[landmark_ids != NO_LANDMARK])
