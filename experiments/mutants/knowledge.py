"""What the settings mean, written down apart from the checks: which values make no sense."""

from __future__ import annotations

import re

# A number may be negative where it is a place, an angle, an offset or an error either way.
_SIGNED = re.compile(r"forward_m|tilt_deg|scale_error_ratio|unequal_ratio|height_m\w+_m|\bc[xy]$")

# 0 divides, is no size, no rate, no share of anything, or never ends.
_ABOVE_0 = re.compile(
    r"voxel_m|resolution_m|size_wh|fov_deg|step_deg|rate_hz|wheel_base_m|depth_scale|f[xy]$"
    r"|feature_count|fast_threshold_min|min_inliers|_limit(_m|_rad)?$|association_gap_s"
    r"|rpe_interval_s|_every$|jpeg_quality|threads|_deadline_s|memory_limit_mb|max_observations"
    r"|catch_up_steps|sigmas|full_well|exposure_gain_max|stride_px|iterations_max|points_per_voxel"
    r"|gap_periods|sync_tolerance_s|range_max_m|workers|duration_s|sigma_px|beams|submap_keyframes"
    r"|search_radius_px|gate\.distance_m|gate\.turn_rad$|speed_max_m_s|turn_max_rad_s|window_m$"
    r"|window_rad|inverse_depth_sigma|degraded_sigma|keyframe_(step|turn|distance|angle)"
)

# A share of a whole is at most 1.
_SHARE = re.compile(
    r"keyframe_inlier_ratio|overlap_ratio|matched_min_ratio|weak_ratio|inlier_min_ratio"
    r"|degeneracy_ratio|ambient_ratio|overlap_min_ratio|\brate_ratio"
)

# null stands for "derived", "all" or "none".
_NULLABLE = re.compile(
    r"^effects$|policy\.gate$|detector\.scenes|topics\.|depth_range_m|lidar_range_m|_frame$"
    r"|catch_up_steps"
)

# Tables whose keys are the user's own names.
_FREE = re.compile(r"^table\.recordings\.|^paper_iv_b\.own\.|^paper_iv_c\.startup_s\.")

# A word out of a list.
_CHOICE = re.compile(
    r"handover|\.mode$|isolation|story|lights|schedule_unit|image_format|\.faults\[|sequence"
    r"|ground_truth_frame|base_frame|topics\."
)

# null until it is given: a number, by its unit or its place.
_NUMBER = re.compile(r"_m$|_s$|_m_s$|workers|max_observations|catch_up_steps|camera\.[fc][xy]$")


def may_be_negative(key: str) -> bool:
    """Tell whether a number below 0 has a meaning."""
    return bool(_SIGNED.search(key))


def may_be_zero(key: str) -> bool:
    """Tell whether 0 has a meaning."""
    return not _ABOVE_0.search(key)


def is_share(key: str) -> bool:
    """Tell whether a number above 1 has no meaning."""
    return bool(_SHARE.search(key))


def may_be_null(key: str) -> bool:
    """Tell whether null has a meaning; where the shipped value is null it has."""
    return bool(_NULLABLE.search(key))


def is_of_a_free_table(key: str) -> bool:
    """Tell whether a key is a name of the user's own, so that none is wrong."""
    return bool(_FREE.search(key))


def is_choice(key: str) -> bool:
    """Tell whether a text is one of few."""
    return bool(_CHOICE.search(key))


def is_number(key: str) -> bool:
    """Tell whether a setting that is null takes a number."""
    return bool(_NUMBER.search(key))


def smaller(key: str, value: float) -> float:
    """Return a value close to a valid one, that is valid as well."""
    if isinstance(value, int):
        return value - 1 if value > 2 else value
    return value * (1.05 if re.search("exposure_gain_max|handover.window_s", key) else 0.95)
