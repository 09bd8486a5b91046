"""Build the parts of the module from its settings and the camera."""

from __future__ import annotations

from sceneslam.types.rig import Camera

from .adjust.local_mapping import LocalMapping
from .locate.certainty import Certainty
from .locate.judgement import HealthRule, KeyframeRule, PlaceRule
from .locate.localizer import VisualLocalizer
from .locate.pose_solver import PoseSolver
from .locate.relocalizer import Relocalizer
from .locate.search import Search
from .map.keyframe_maker import KeyframeMaker
from .map.layers import LayerBuilder
from .map.map_history import MapHistory
from .map.visual_map import VisualMap
from .see.alignment import Alignment
from .see.features import FeatureExtractor
from .see.rectifying_extractor import RectifyingExtractor
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
        extractor = FeatureExtractor(
            depth_camera,
            known,
            count=settings.feature_count,
            fast_threshold_min=settings.fast_threshold_min,
            fast_noise_ratio=settings.fast_noise_ratio,
        )
        self.map = VisualMap(
            camera,
            depth_camera,
            sigma_px=settings.sigma_px,
            inverse_depth_sigma_per_m=settings.inverse_depth_sigma_per_m,
            keyframe_limit=settings.keyframe_limit,
            landmark_limit=settings.landmark_limit,
        )
        self.localizer = VisualLocalizer(
            self.map,
            PoseSolver(camera, seed=settings.seed),
            radius_px=settings.search_radius_px,
            min_inliers=settings.min_inliers,
        )
        self.eye = RectifyingExtractor(self.map, self.localizer, extractor)
        self.memory = MapHistory(
            self.map,
            self.localizer,
            self.eye,
            min_inliers=settings.degraded_inliers,
            is_repeatable=settings.is_repeatable,
        )
        relocalizer = Relocalizer(self.map.keyframes, self.memory.recognizer)
        self.search = Search(self.localizer, relocalizer)
        self.mapping = LocalMapping(
            depth_camera, self.map, alignment=alignment, is_repeatable=settings.is_repeatable
        )
        self.layers = LayerBuilder(
            depth_camera,
            cloud_stride_px=settings.cloud_stride_px,
            cloud_voxel_m=settings.cloud_voxel_m,
            grid_resolution_m=settings.grid_resolution_m,
        )
        self.maker = KeyframeMaker(self.map, self.layers, self.memory, self.mapping)
        self.keyframe_rule = KeyframeRule(
            step_m=settings.keyframe_step_m,
            turn_rad=settings.keyframe_turn_rad,
            inlier_ratio=settings.keyframe_inlier_ratio,
        )
        self.place_rule = PlaceRule(patience_s=settings.segment_patience_s)
        self.certainty = Certainty(self.map.landmarks)
        self.health = HealthRule(
            degraded_inliers=settings.degraded_inliers, degraded_sigma_m=settings.degraded_sigma_m
        )
