"""The parts of the module, built from its settings and the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

from .adjust.fusion import join_duplicates
from .adjust.local_mapping import LocalMapping
from .adjust.triangulation import triangulate
from .locate.certainty import Certainty
from .locate.judgement import HealthRule, KeyframeRule, PlaceRule
from .locate.localizer import VisualFix, VisualLocalizer
from .locate.pose_solver import PoseSolver
from .locate.relocalizer import Relocalizer
from .locate.search import Search
from .map.keyframes import NO_LANDMARK, Keyframe
from .map.layers import LayerBuilder
from .map.map_history import MapHistory
from .map.visual_map import VisualMap
from .see.alignment import Alignment
from .see.features import FeatureExtractor
from .see.rectifying_extractor import RectifyingExtractor
from .see.view import View
from .settings import RgbdSettings


class RgbdParts:
    """An empty map with the parts for extraction, localization, mapping, rules and history."""

    def __init__(
        self,
        settings: RgbdSettings,
        depth_camera: Camera,
        alignment: Alignment | None,
    ) -> None:
        """Build; `alignment` None: assume registered depth until the search shows otherwise."""
        known = alignment or Alignment()
        camera = known.color_camera(depth_camera)
        extractor = FeatureExtractor(depth_camera, known, settings=settings)
        self.map = VisualMap(camera, depth_camera, settings=settings)
        solver = PoseSolver(camera, seed=settings.seed, min_inliers=settings.min_inliers)
        self.localizer = VisualLocalizer(self.map, solver, settings=settings)
        self.eye = RectifyingExtractor(self.map, self.localizer, extractor)
        self.memory = MapHistory(self.map, self.localizer, self.eye, settings=settings)
        relocalizer = Relocalizer(self.map.keyframes, self.memory.recognizer)
        self.search = Search(self.localizer, relocalizer)
        self.mapping = LocalMapping(
            depth_camera, self.map, alignment=alignment, is_repeatable=settings.is_repeatable
        )
        self.layers = LayerBuilder(depth_camera, settings)
        self.keyframe_rule, self.place_rule = KeyframeRule(settings), PlaceRule(settings)
        self.health, self.certainty = HealthRule(settings), Certainty(self.map.landmarks)

    def insert(
        self,
        view: View,
        T_local_base: Transform,
        segment: set[int] | None,
        *,
        fix: VisualFix | None = None,
        predicted: NDArray[np.float64] | None = None,
        guessed_s: float | None = None,
    ) -> NDArray[np.int64]:
        """Insert a keyframe at a pose (4, 4) and return the ids (N,) of its landmarks.

        `segment`: the keyframes whose landmarks these may be, None: all. `fix`: the pose found in
        the map, None for odometry, with covariance `predicted` (6, 6). `guessed_s`: time without a
        pose if the pose is a guess.
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
            view=self.layers.view(view.depth_m, view.image_bgr, stamp_ns=stamp_ns),
            turning=view.turning,
            is_monocular=view.is_monocular,
            odometry=view.odometry,
        )
        deep_rows = landmark_ids[:0] if fix is None else fix.deep_rows
        keyframe_id = self.map.insert(keyframe, deep_rows=deep_rows)
        triangulate(self.map, keyframe_id)
        join_duplicates(self.map, keyframe, segment)
        self.memory.insert(fix, view.depth_m, predicted=predicted, guessed_s=guessed_s)
        self.mapping.insert(keyframe_id, view)
        self.keyframe_rule.restart()
        return np.asarray(landmark_ids[landmark_ids != NO_LANDMARK])
