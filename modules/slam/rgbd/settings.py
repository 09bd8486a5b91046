"""The module's settings; `conf/slam/rgbd.yaml` says what each means."""

from __future__ import annotations

from dataclasses import dataclass

from sceneslam.types.ranges import Checked, check_between, ranged


@dataclass(kw_only=True, eq=False)
class RgbdSettings(Checked):
    """All numbers of the configuration; ConfigError for one that is out of its range."""

    segment_patience_s: float = ranged(check_between, 0, 1e9)
    feature_count: int = ranged(check_between, 100, 10_000)
    fast_threshold_min: int = ranged(check_between, 1, 20)
    fast_noise_ratio: float = ranged(check_between, 0, 100)
    sigma_px: float = ranged(check_between, 0.01, 10)
    inverse_depth_sigma_per_m: float = ranged(check_between, 1e-5, 1)
    search_radius_px: float = ranged(check_between, 1, 200)
    min_inliers: int = ranged(check_between, 6, 1000)
    degraded_inliers: int = ranged(check_between, 6, 1000)
    degraded_sigma_m: float = ranged(check_between, 1e-4, 10)
    keyframe_step_m: float = ranged(check_between, 0.001, 100)
    keyframe_turn_rad: float = ranged(check_between, 0.001, 3.2)
    keyframe_inlier_ratio: float = ranged(check_between, 0, 1)
    keyframe_limit: int = ranged(check_between, 3, 1_000_000)
    landmark_limit: int = ranged(check_between, 1000, 100_000_000)
    cloud_stride_px: int = ranged(check_between, 1, 100)
    cloud_voxel_m: float = ranged(check_between, 0.001, 10)
    grid_resolution_m: float = ranged(check_between, 0.001, 10)
    is_repeatable: bool
    seed: int = ranged(check_between, 0, 2**31 - 1)
