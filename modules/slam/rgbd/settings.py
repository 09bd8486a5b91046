"""The module's settings; `conf/slam/rgbd.yaml` says what each means."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from sceneslam.types.errors import ConfigError


def _within(low: float, high: float) -> Any:
    return field(metadata={"range": (low, high)})


@dataclass(kw_only=True, eq=False)
class RgbdSettings:
    """All numbers of the configuration; ConfigError for one that is out of its range."""

    segment_patience_s: float = _within(0, 1e9)
    feature_count: int = _within(100, 10_000)
    fast_threshold_min: int = _within(1, 20)
    fast_noise_ratio: float = _within(0, 100)
    sigma_px: float = _within(0.01, 10)
    inverse_depth_sigma_per_m: float = _within(1e-5, 1)
    search_radius_px: float = _within(1, 200)
    min_inliers: int = _within(6, 1000)
    degraded_inliers: int = _within(6, 1000)
    degraded_sigma_m: float = _within(1e-4, 10)
    keyframe_step_m: float = _within(0.001, 100)
    keyframe_turn_rad: float = _within(0.001, 3.2)
    keyframe_inlier_ratio: float = _within(0, 1)
    keyframe_limit: int = _within(3, 1_000_000)
    landmark_limit: int = _within(1000, 100_000_000)
    cloud_stride_px: int = _within(1, 100)
    cloud_voxel_m: float = _within(0.001, 10)
    grid_resolution_m: float = _within(0.001, 10)
    is_repeatable: bool = _within(False, True)
    seed: int = _within(0, 2**31 - 1)

    def __post_init__(self) -> None:
        for each in (one for one in fields(self) if "range" in one.metadata):
            value, (low, high) = getattr(self, each.name), each.metadata["range"]
            if not (isinstance(value, (int, float)) and low <= value <= high):
                raise ConfigError(each.name, value, f"{low:g} to {high:g}")
