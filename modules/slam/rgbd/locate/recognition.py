"""Decide whether an image shows a place of the map, with checks that similar places fail."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.se3 import Transform
from sceneslam.views.place_index import PlaceIndex

from ...surfaces.undistortion import DepthUndistortion
from ..map.keyframes import Keyframe
from ..map.visual_map import VisualMap
from ..see.alignment import look_up
from ..see.features import Features
from .localizer import VisualFix, VisualLocalizer

_MIN_FOUND_RATIO = 0.2  # of the expected landmarks, found at least
_MIN_SURFACE_RATIO = 0.7  # of the surfaces in both depth images, agreeing at least
_MIN_COMMON_RATIO = 0.02  # of the pixels of a keyframe's cloud, in both depth images at least
_MIN_COMMON_POINTS = 5  # where its cloud is coarse
_SURFACE_SLACK_M = 0.05  # tolerance for the pose error
_SURFACE_SIGMAS = 4.0  # of one depth, so 2.8 of a difference


class PlaceRecognizer:
    """Recognises the map's keyframes in images, independent of the predicted pose.

    The same poster on two walls is distinguished: at the wrong wall, other landmarks are not found,
    and the depths around it differ.
    """

    def __init__(
        self, visual_map: VisualMap, localizer: VisualLocalizer, *, min_inliers: int
    ) -> None:
        self._map, self._localizer = visual_map, localizer
        self._min_inliers = min_inliers
        self._undistortion = DepthUndistortion(visual_map.depth_camera)
        self.places = PlaceIndex()

    def recognize(
        self, keyframe_id: int, features: Features, depth_m: NDArray[np.float32] | None
    ) -> VisualFix | None:
        """Return the pose at which a keyframe agrees with an image and depth (H, W) [m]."""
        if len(features) < self._min_inliers:
            return None
        keyframe = self._map.keyframes[keyframe_id]
        landmark_ids = self._map.keyframes.landmarks_of([keyframe_id])
        fix = self._localizer.anywhere(features, landmark_ids)
        if fix is None or len(fix.landmark_ids) < self._min_inliers:
            return None
        if fix.found_ratio(features) < _MIN_FOUND_RATIO:
            return None
        if depth_m is not None and not self._shows(keyframe, fix.estimate.T_local_base, depth_m):
            return None
        return fix

    def _shows(
        self, keyframe: Keyframe, T_local_base: Transform, depth_m: NDArray[np.float32]
    ) -> bool:
        """Tell whether a depth image (H, W) [m] at a pose agrees with a keyframe's surfaces.

        True for a keyframe without depth, as nothing can be compared.
        """
        camera = self._map.depth_camera
        points_base, pixels = keyframe.view.points_base, keyframe.view.pixels
        if not len(points_base):
            return True
        T_cam_keyframe = se3.inverse(T_local_base @ camera.T_base_cam) @ keyframe.T_local_base
        points_cam = se3.apply(T_cam_keyframe, points_base)
        points_cam = points_cam[points_cam[:, 2] > camera.depth_range_m[0]]
        z = points_cam[:, 2]
        uv_px = points_cam[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        depth_m = self._undistortion.apply(depth_m)
        seen_m = look_up(depth_m[None], np.zeros(len(z), np.int64), uv_px)
        measured = camera.measures(seen_m)
        if measured.sum() < max(_MIN_COMMON_RATIO * pixels, _MIN_COMMON_POINTS):
            return False
        seen_m, z = seen_m[measured], z[measured]
        sigma_m = self._map.inverse_depth_sigma_per_m * seen_m**2
        agree = np.abs(z - seen_m) <= _SURFACE_SLACK_M + _SURFACE_SIGMAS * sigma_m
        return bool(agree.mean() >= _MIN_SURFACE_RATIO)
