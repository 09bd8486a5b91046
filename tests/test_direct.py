"""Direct RGB-D tracking: without corners, and honest about what it does not see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sceneslam.modules.slam.camera_certainty import CORRELATION
from sceneslam.modules.slam.direct.comparison import compare
from sceneslam.modules.slam.direct.module import DirectSlam
from sceneslam.modules.slam.direct.view import Tracker
from sceneslam.testing import RIG, room_observation
from sceneslam.testing.room import CAMERA, observation_at
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import TrackingStatus

SETTINGS = yaml.safe_load((Path(__file__).parents[1] / "conf/slam/direct.yaml").read_text())
SETTINGS.pop("_target_")
SILENT = {"T_odom_base": None, "gyro_base": None}


def active(**settings):
    module = DirectSlam(**{**SETTINGS, **settings})
    module.activate(RIG)
    return module


def shaded(index):
    """Return an observation without one corner: only soft shading is left of the texture."""
    seen = room_observation(index)
    return replace(seen, image_bgr=cv2.GaussianBlur(seen.image_bgr, (0, 0), 8), **SILENT)


def test_it_follows_shading_without_corners():
    grey = cv2.cvtColor(shaded(0).image_bgr, cv2.COLOR_BGR2GRAY)
    assert len(cv2.FastFeatureDetector_create(7).detect(grey)) < 20
    module = active()
    found = [module.track(shaded(index)) for index in range(20)]
    T_first, T_last = (room_observation(index).T_odom_base for index in (0, 19))
    off = se3.inverse(se3.inverse(T_first) @ T_last) @ found[-1].T_local_base
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert all(one.status is TrackingStatus.TRACKING for one in found)
    assert len(module.get_map().points.points) > 1000


@pytest.mark.parametrize("odometry", [False, True])
def test_an_image_of_another_place_is_no_pose(odometry):
    elsewhere = observation_at(se3.from_xy_yaw(1.0, 1.0, 2.5), 4 / 30)
    module = active()
    for index in range(4):
        seen = room_observation(index)
        module.track(seen if odometry else replace(seen, **SILENT))
    kept = {"T_odom_base": room_observation(4).T_odom_base} if odometry else SILENT
    found = module.track(replace(elsewhere, **kept))
    expected = TrackingStatus.DEGRADED if odometry else TrackingStatus.LOST
    assert found.status is expected and (found.covariance is None) is not odometry


@pytest.mark.parametrize("is_blind", [False, True])
def test_a_first_keyframe_after_unknown_motion_is_degraded(is_blind):
    module = active()
    if is_blind:
        seen = room_observation(0)
        blind = replace(seen, depth_m=np.zeros_like(seen.depth_m), **SILENT)
        assert module.track(blind).status is TrackingStatus.LOST
    first, second = (
        module.track(replace(room_observation(index), **SILENT)).status for index in (1, 2)
    )
    assert first is (TrackingStatus.DEGRADED if is_blind else TrackingStatus.TRACKING)
    assert second is TrackingStatus.TRACKING


def test_a_blank_wall_is_degraded_along_itself():
    wall = replace(
        room_observation(0),
        image_bgr=np.full((CAMERA.size_wh[1], CAMERA.size_wh[0], 3), 128, np.uint8),
        depth_m=np.full((CAMERA.size_wh[1], CAMERA.size_wh[0]), 2.0, np.float32),
        **SILENT,
    )
    module = active()
    found = [module.track(replace(wall, stamp_ns=wall.stamp_ns + i * 33_000_000)) for i in range(5)]
    assert found[-1].status is not TrackingStatus.TRACKING
    if found[-1].covariance is not None:
        along, across = np.diag(found[-1].covariance)[[1, 0]]  # the camera looks along x
        assert along > 4 * across


def test_information_is_that_of_the_residuals():
    tracker = Tracker(CAMERA, 320, 0.3, 0.4)
    views = [
        tracker.view(seen.image_bgr, seen.depth_m)
        for seen in (room_observation(index) for index in (0, 3))
    ]
    T_other_view = tracker.register(views[1], views[0])
    found = compare(tracker, views[1], views[0], T_other_view)
    assert found.matched_ratio > 0.9
    assert np.linalg.eigvalsh(found.information).min() > 0
    off = T_other_view @ se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert compare(tracker, views[1], views[0], off).matched_ratio < found.matched_ratio


def test_pixels_that_err_together_count_as_few():
    """The right half is seen two pixels off, as by a wrong lens."""
    tracker, seen = Tracker(CAMERA, 320, 0.3, 0.4), room_observation(0)
    view, draw = tracker.view(seen.image_bgr, seen.depth_m), np.random.default_rng(0)
    middle = CAMERA.size_wh[0] // 2
    bent = seen.image_bgr.copy()
    bent[:, middle:] = np.roll(bent[:, middle:], 2, axis=1)
    found = []
    for image_bgr in (seen.image_bgr, bent):
        noisy = np.clip(image_bgr + 3.0 * draw.normal(size=bent.shape), 0, 255).astype(np.uint8)
        found.append(compare(tracker, tracker.view(noisy, seen.depth_m), view, np.eye(4)))
    independent, common = (one.common_ratio for one in found)
    assert independent < 5.0 and common > CORRELATION


def test_a_moment_without_depth_leaves_the_keyframe_as_it_is():
    module = active()
    for index in range(3):
        module.track(room_observation(index))
    blank = np.full_like(room_observation(3).depth_m, np.nan)
    found = module.track(replace(room_observation(3), depth_m=blank))
    assert found.status is TrackingStatus.DEGRADED
    assert module.track(room_observation(4)).status is TrackingStatus.TRACKING


def test_a_frozen_image_is_not_tracked():
    """It says with certainty that nothing moves; depth says that something does."""
    module, first = active(), room_observation(0)
    module.track(first)
    later = [replace(room_observation(k), image_bgr=first.image_bgr) for k in range(1, 10)]
    found = [module.track(one).status for one in later]
    assert found[0] is TrackingStatus.TRACKING  # cameras repeat single images
    assert set(found[3:]) <= {TrackingStatus.DEGRADED, TrackingStatus.LOST}
    assert module.track(room_observation(10)).status is TrackingStatus.TRACKING


@pytest.mark.parametrize("grey", [0, 255])
def test_black_and_white_images_are_not_frozen_ones(grey):
    module, blank = active(), np.full_like(room_observation(0).image_bgr, grey)
    for index in range(10):
        module.track(replace(room_observation(index), image_bgr=blank))
    assert module._new_ns == room_observation(9).stamp_ns


@pytest.mark.parametrize("seed", range(6))
def test_views_of_a_wall_with_one_poster_agree_best_where_it_is(seed):
    tracker, random = Tracker(CAMERA, 320, 0.3, 0.4), np.random.default_rng(seed)
    width, height = CAMERA.size_wh
    poster = cv2.GaussianBlur(random.uniform(0, 255, (height, width)), (0, 0), 4) * 2 - 100
    poster[:, : int(0.7 * width)] = 120.0
    views = []
    for _ in range(2):
        noisy = (poster + random.normal(0.0, 0.5, poster.shape)).clip(0, 255).astype(np.uint8)
        depth_m = 2.0 + random.normal(0.0, 0.008, poster.shape)
        image = cv2.cvtColor(noisy, cv2.COLOR_GRAY2BGR)
        views.append(tracker.view(image, depth_m.astype(np.float32)))
    away = se3.exp(np.array([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]))
    right, wrong = (compare(tracker, views[1], views[0], T) for T in (np.eye(4), away))
    assert right.misfit < wrong.misfit


@pytest.mark.parametrize(("sees_noise", "share_max"), [(False, 1.0), (True, 0.05)])
def test_the_noise_of_a_dark_image_says_nothing_of_where_it_is(sees_noise, share_max):
    """A flat wall, seen twice from one place: along it, only the image can tell."""
    tracker, random = Tracker(CAMERA, 640, 0.3, 0.4), np.random.default_rng(0)
    width, height = CAMERA.size_wh
    depth_m = np.full((height, width), 2.0, np.float32)
    texture = cv2.GaussianBlur(random.uniform(0, 255, (height, width)), (0, 0), 4) * 2 - 100

    def information(contrast):
        views = []
        for _ in range(2):
            grey = 20.0 + contrast * texture + random.normal(0.0, 5.0, texture.shape)
            image = cv2.cvtColor(grey.clip(0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
            views.append(tracker.view(image, depth_m))
        return compare(tracker, views[1], views[0], np.eye(4)).information[0, 0]

    lit = information(1.0)
    assert lit > 1e4  # within 1 cm
    assert (information(0.0) < share_max * lit) or not sees_noise


@pytest.mark.parametrize(("key", "value"), [("width_px", 0), ("matched_min_ratio", 1.0)])
def test_a_setting_that_makes_no_sense_is_named(key, value):
    with pytest.raises(ConfigError, match=key):
        active(**{key: value})
