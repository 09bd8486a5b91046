"""Features made up for the tests of the rgbd module's parts."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import yaml

from sceneslam.modules.slam.rgbd.map.visual_map import VisualMap
from sceneslam.modules.slam.rgbd.see.features import Features
from sceneslam.modules.slam.rgbd.see.shutter import Turning
from sceneslam.modules.slam.rgbd.settings import RgbdSettings

CONFIG = Path(__file__).parents[1] / "conf" / "slam" / "rgbd.yaml"
AT_REST = Turning(rate_cam=np.zeros(3), twist_per_s=np.zeros(6))


def features_at(uv_px, descriptors, levels=None, depth_m=None):
    count = len(uv_px)
    return Features(
        uv_px=np.asarray(uv_px, float),
        levels=np.zeros(count, np.int64) if levels is None else levels,
        descriptors=descriptors,
        depth_m=np.zeros(count) if depth_m is None else depth_m,
        depth_slope_m_per_px=np.zeros(count),
    )


def random_descriptors(rng, count):
    return rng.integers(0, 256, (count, 32), dtype=np.uint8)


def settings_with(**changes):
    """Return the module's settings as they are configured, with changes."""
    given = yaml.safe_load(CONFIG.read_text()) | {"seed": 0, "is_repeatable": True} | changes
    return RgbdSettings(**{each.name: given[each.name] for each in fields(RgbdSettings)})


def empty_map(camera, *, keyframe_limit=9, landmark_limit=9999):
    settings = settings_with(keyframe_limit=keyframe_limit, landmark_limit=landmark_limit)
    return VisualMap(camera, camera, settings=settings)
