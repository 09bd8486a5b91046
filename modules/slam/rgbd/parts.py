"""Build the module's parts from its arguments and the camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sceneslam.types.rig import Camera

from .alignment import Alignment
from .certainty import Certainty
from .features import FeatureExtractor
from .judgement import HealthRule, KeyframeRule, PlaceRule
from .keyframe_maker import KeyframeMaker
from .layers import LayerBuilder
from .local_mapping import LocalMapping
from .localizer import VisualLocalizer
from .map_history import MapHistory
from .pose_solver import PoseSolver
from .rectifying_extractor import RectifyingExtractor
from .relocalizer import Relocalizer
from .reunion import Reunion
from .search import Search
from .visual_map import VisualMap


class RgbdParts:
    """An empty map with the parts for extraction, localization, mapping, rules and history."""

    def __init__(
        self,
        arguments: Mapping[str, Any],
        depth_camera: Camera,
        alignment: Alignment | None,
        reunion: Reunion,
    ) -> None:
        """Build; `alignment` None: assume registered depth until the search shows otherwise."""

        def chosen(**names: str) -> dict[str, Any]:
            return {name: arguments[argument] for name, argument in names.items()}

        def same(*names: str) -> dict[str, Any]:
            return {name: arguments[name] for name in names}

        known = alignment or Alignment()
        camera = known.color_camera(depth_camera)
        extractor = FeatureExtractor(
            depth_camera,
            known,
            **chosen(count="feature_count"),
            **same("fast_threshold_min", "fast_noise_ratio"),
        )
        self.map = VisualMap(
            camera,
            depth_camera,
            **same("sigma_px", "inverse_depth_sigma_per_m", "keyframe_limit", "landmark_limit"),
        )
        localizer = VisualLocalizer(
            self.map,
            PoseSolver(camera, **same("seed")),
            **chosen(radius_px="search_radius_px", min_inliers="min_inliers"),
        )
        self.eye = RectifyingExtractor(self.map, localizer, extractor)
        self.memory = MapHistory(
            self.map,
            localizer,
            self.eye,
            reunion,
            **chosen(min_inliers="degraded_inliers"),
            **same("is_repeatable"),
        )
        relocalizer = Relocalizer(self.map.keyframes, self.memory.recognizer)
        self.search = Search(localizer, relocalizer)
        self.mapping = LocalMapping(
            depth_camera, self.map, alignment=alignment, **same("is_repeatable")
        )
        self.layers = LayerBuilder(
            depth_camera, **same("cloud_stride_px", "cloud_voxel_m", "grid_resolution_m")
        )
        self.maker = KeyframeMaker(self.map, self.layers, self.memory, self.mapping)
        self.keyframe_rule = KeyframeRule(
            **chosen(
                step_m="keyframe_step_m",
                turn_rad="keyframe_turn_rad",
                inlier_ratio="keyframe_inlier_ratio",
            )
        )
        self.place_rule = PlaceRule(**chosen(patience_s="segment_patience_s"))
        self.certainty = Certainty(self.map.landmarks)
        self.health = HealthRule(**same("degraded_inliers", "degraded_sigma_m"))
