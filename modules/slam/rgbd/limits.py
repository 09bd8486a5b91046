"""Check the constructor's arguments and the images' sizes."""

from __future__ import annotations

from collections.abc import Mapping

from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera

_LIMITS: dict[str, tuple[float, float]] = {
    "segment_patience_s": (0, 1e9),
    "feature_count": (100, 10_000),
    "fast_threshold_min": (1, 20),
    "fast_noise_ratio": (0, 100),
    "sigma_px": (0.01, 10),
    "inverse_depth_sigma_per_m": (1e-5, 1),
    "search_radius_px": (1, 200),
    "min_inliers": (6, 1000),
    "degraded_inliers": (6, 1000),
    "degraded_sigma_m": (1e-4, 10),
    "keyframe_step_m": (0.001, 100),
    "keyframe_turn_rad": (0.001, 3.2),
    "keyframe_inlier_ratio": (0, 1),
    "keyframe_limit": (3, 1_000_000),
    "past_keyframe_limit": (0, 1_000_000),
    "landmark_limit": (1000, 100_000_000),
    "cloud_stride_px": (1, 100),
    "cloud_voxel_m": (0.001, 10),
    "grid_resolution_m": (0.001, 10),
    "is_repeatable": (False, True),
    "seed": (0, 2**31 - 1),
}


def check_limits(arguments: Mapping[str, object]) -> None:
    """Raise ConfigError for the first argument that is out of its range."""
    for name, (low, high) in _LIMITS.items():
        value = arguments[name]
        if not (isinstance(value, (int, float)) and low <= value <= high):
            raise ConfigError(name, value, f"{low:g} to {high:g}")


def check_sizes(observation: Observation, camera: Camera) -> None:
    """Raise InputError if an array does not have the camera's size."""
    width, height = camera.size_wh
    image_bgr, depth_m = observation.image_bgr, observation.depth_m
    if image_bgr is not None and image_bgr.shape != (height, width, 3):
        raise InputError(f"image_bgr: expected ({height}, {width}, 3), got {image_bgr.shape}")
    if depth_m is not None and depth_m.shape != (height, width):
        raise InputError(f"depth_m: expected ({height}, {width}), got {depth_m.shape}")
