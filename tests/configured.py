"""The configuration of a whole run of fakes, with changes."""

from copy import deepcopy

CONFIG = {
    "source": {"_target_": "fakes.FakeSource", "steps": 100, "dark_from": 40},
    "detector": {
        "_target_": "sceneslam.modules.detectors.grey_mean.GreyMean",
        "scenes": ["Bright", "Dark"],
        "threshold": 100.0,
        "hysteresis": 0.0,
    },
    "slam": {
        "bright": {"_target_": "fakes.ExactModule"},
        "dark": {"_target_": "fakes.ExactModule"},
    },
    "scenes": {"Bright": ["bright", "dark"], "Dark": ["dark", "bright"]},
    "policy": {
        "_target_": "sceneslam.bus.policy.Policy",
        "handover": "cold",
        "confirm_window_s": 2.0,
        "first_confirm_window_s": 0.0,
        "lost_patience_s": 0.3,
        "retry_s": 2.0,
        "buffer_s": 12.0,
        "buffer_mb": 256.0,
        "catch_up": {
            "_target_": "sceneslam.bus.pace.PaceSettings",
            "period_s": 0.06,
            "step_m": 0.05,
        },
        "scene_filter": None,
        "gate": None,
        "startup_s": {},
    },
    "atlas": {"_target_": "sceneslam.atlas.atlas.Atlas", "voxel_m": 0.05},
    "evaluation": {
        "_target_": "sceneslam.evaluation.settings.EvaluationSettings",
        "association_gap_s": 0.01,
        "rpe_interval_s": 1.0,
        "segment_m": 10.0,
        "correct_limit_m": 0.25,
        "correct_limit_ratio": 0.0,
        "correct_limit_rad": 0.17,
        "drawn_threshold": None,
        "coverage_min_ratio": 0.9,
        "scenes": {},
    },
    "run": {
        "_target_": "sceneslam.config.settings.RunSettings",
        "mode": "recording",
        "threads": 1,
        "isolation": "inline",
        "step_deadline_s": 10.0,
        "start_deadline_s": 60.0,
        "memory_limit_mb": 4000,
        "restarts_max": 5,
        "restart_window_s": 60.0,
        "restart_backoff_s": 0.2,
        "progress": False,
        "report": True,
        "max_observations": None,
        "rate": 1.0,
        "silent_after_s": 1.0,
        "end_after_s": None,
        "is_repeatable": True,
        "catch_up_steps": None,
    },
    "allow_targets": ["fakes"],
}


def config(**changes):
    """Return the configuration with values changed by dotted key (dots as __)."""
    changed = deepcopy(CONFIG)
    for key, value in changes.items():
        *path, last = key.split("__")
        node = changed
        for name in path:
            node = node[name]
        if value is ...:
            del node[last]
        else:
            node[last] = value
    return changed
