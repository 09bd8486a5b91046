"""The rgbd module without depth: on the map it has, on odometry, and on neither."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_rgbd import drive, make

from sceneslam.bus.judging.runner import Runner
from sceneslam.executors import InStep
from sceneslam.testing.room import observation_at
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

IMAGES, WITH_DEPTH = 48, 4


def pose(index):
    """Facing a corner and moving across it, past what the first images show: 4 cm per image."""
    return se3.from_xy_yaw(0.4 - 0.02 * index, -1.2 + 0.034 * index, 0.53)


WAY_M = float(np.linalg.norm((pose(IMAGES - 1) - pose(0))[:3, 3]))


@cache
def seen(index):
    observation = observation_at(pose(index), index / 10.0)
    return replace(observation, scan=None, points_lidar=None, gyro_base=None)


def images(*, depth, odometry):
    """Observations whose depth is there for the first `depth` of them."""
    for index in range(IMAGES):
        observation = seen(index)
        if not odometry:
            observation = replace(observation, T_odom_base=None)
        yield observation if index < depth else replace(observation, depth_m=None)


def error_m(answer, index):
    T_true = se3.inverse(pose(0)) @ pose(index)
    return float(np.linalg.norm((se3.inverse(T_true) @ answer.T_local_base)[:3, 3]))


def test_new_landmarks_carry_the_camera_past_what_depth_has_shown():
    module = make()
    answers = drive(module, images(depth=WITH_DEPTH, odometry=False))
    assert all(answer.status is not TrackingStatus.LOST for answer in answers)
    assert max(error_m(answer, index) for index, answer in enumerate(answers)) < 0.1 * WAY_M
    assert np.trace(answers[-1].covariance) > np.trace(answers[WITH_DEPTH].covariance)
    landmarks = module.get_map().landmarks
    born_late = landmarks.first_stamps_ns > seen(WITH_DEPTH - 1).stamp_ns
    assert born_late.sum() > 200
    true = se3.apply(pose(0), landmarks.points[born_late].astype(float))
    beyond_wall_m = (np.abs(true) - [3.0, 2.0, 1.2]).max(axis=1)
    assert np.median(np.abs(beyond_wall_m)) < 0.1


def test_depth_that_comes_back_finds_the_same_map():
    module = make()
    observations = list(images(depth=WITH_DEPTH, odometry=False))
    observations[36:] = [replace(seen(i), T_odom_base=None) for i in range(36, IMAGES)]
    answers = drive(module, observations)
    assert all(answer.status is not TrackingStatus.LOST for answer in answers)
    assert answers[-1].revision == 0
    assert error_m(answers[-1], IMAGES - 1) < 0.1 * WAY_M


def test_odometry_gives_the_scale_of_a_map_that_begins_without_depth():
    answers = drive(make(), images(depth=0, odometry=True))
    assert answers[0].status is TrackingStatus.TRACKING
    np.testing.assert_allclose(answers[0].T_local_base, np.eye(4), atol=1e-9)
    held = [a.status is not TrackingStatus.LOST for a in answers]
    assert sum(held[IMAGES // 2 :]) == IMAGES // 2
    assert error_m(answers[-1], IMAGES - 1) < 0.1 * WAY_M


def test_without_depth_or_odometry_nothing_is_begun():
    answers = drive(make(), images(depth=0, odometry=False))
    assert all(answer.status is TrackingStatus.LOST for answer in answers)


@pytest.mark.parametrize("scene", ["Outdoor", "Bright"])
def test_depth_is_not_used_in_a_monocular_scene(scene):
    module = make(monocular_scenes=["Outdoor"])
    drive(module, [seen(0), seen(1)])
    module.set_scene(scene)
    lying = [replace(seen(i), depth_m=1.3 * seen(i).depth_m, T_odom_base=None) for i in (2, 3)]
    answer = drive(module, lying)[-1]
    assert (answer.status is TrackingStatus.TRACKING) == (scene == "Outdoor")


def test_observation_without_an_image_is_not_asked_of_it():
    runner = Runner("rgbd", make(), InStep())
    assert runner.can_use(seen(0)) and runner.can_use(replace(seen(0), depth_m=None))
    assert not runner.can_use(replace(seen(0), image_bgr=None))


def test_keyframes_are_of_images_with_depth_while_that_comes_more_rarely():
    """In a turn, where two images without depth tell no distance; then depth ends."""
    module, count, ends = make(), 42, 30
    for index in range(count):
        at = se3.from_xy_yaw(0.4 - 0.03 * max(index - ends, 0), -1.2, 0.4 + 0.03 * min(index, ends))
        observation = replace(observation_at(at, index / 30.0), scan=None, T_odom_base=None)
        if index % 3 or index >= ends:
            observation = replace(observation, depth_m=None)
        assert module.track(observation).status is not TrackingStatus.LOST
    keyframes = module._parts.map.keyframes
    without_ns = [keyframes[k].stamp_ns for k in keyframes.ids if keyframes[k].is_monocular]
    assert len(keyframes.ids) - len(without_ns) >= 3
    assert without_ns and min(without_ns) >= round(ends / 30.0 * 1e9)
