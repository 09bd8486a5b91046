"""The rgbd module closes loops that are there, and none that only seem to be."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from test_rgbd import make

from sceneslam.testing.room import CAMERA, RIG, observation_at
from sceneslam.types import se3

TURN_STEPS = 72
AGAIN = 16  # images after the turn is full
FOCAL_ERROR = 1.03  # lets a full turn drift by some degrees


def seen_from(T_room_base, index):
    observation = observation_at(T_room_base, index / 30.0)
    return replace(observation, scan=None, points_lidar=None, T_odom_base=None, gyro_base=None)


@cache
def round_trip():
    """Observations of a turn in a small circle, a bit more than once around."""
    turns = np.arange(TURN_STEPS + AGAIN) * 2 * np.pi / TURN_STEPS
    poses = [se3.from_xy_yaw(0.3 * np.cos(a), 0.3 * np.sin(a), a) for a in turns.tolist()]
    return [seen_from(T, index) for index, T in enumerate(poses)]


def turn_around():
    """Drive once around with a camera that is taken for another; return all that came of it."""
    wrong = replace(CAMERA, fx=CAMERA.fx * FOCAL_ERROR, fy=CAMERA.fy * FOCAL_ERROR)
    module = make(replace(RIG, camera=wrong))
    answers = [module.track(observation) for observation in round_trip()]
    revised = module.get_trajectory()
    layers = module.get_map()
    module.shutdown()
    return answers, revised, layers


@cache
def turned_around():
    return turn_around()


def drift_rad(T_local_base):
    """How wrong the turn between two views of one place is."""
    T_once_again = se3.inverse(T_local_base[AGAIN // 2]) @ T_local_base[TURN_STEPS + AGAIN // 2]
    return se3.rotation_angle_rad(T_once_again)


def test_loop_is_closed_and_the_past_corrected():
    pytest.importorskip("gtsam")
    answers, revised, layers = turned_around()
    told = np.stack([answer.T_local_base for answer in answers])
    assert len(told) == len(revised) == TURN_STEPS + AGAIN
    assert layers.pose_graph.is_loop.any()
    assert answers[0].revision == 0 and answers[-1].revision >= 1
    drift_told, drift_revised = (drift_rad(T) for T in (told, revised.T_world_base))
    assert drift_told > np.deg2rad(3.0)
    assert drift_revised < 0.25 * drift_told
    # From the correction on, the pose that is told is the corrected one.
    np.testing.assert_allclose(told[-1], revised.T_world_base[-1], atol=1e-9)


def test_pose_jumps_only_where_a_revision_says_so():
    answers, _, _ = turned_around()
    steps_rad = [
        se3.rotation_angle_rad(se3.inverse(one.T_local_base) @ other.T_local_base)
        for one, other in pairwise(answers)
    ]
    revised = [one.revision != other.revision for one, other in pairwise(answers)]
    usual_rad = 2 * np.pi / TURN_STEPS
    unusual = np.abs(np.array(steps_rad) - usual_rad) > 0.2 * usual_rad
    assert unusual.any() and not (unusual & ~np.array(revised)).any()


def test_loop_is_closed_twice_the_same_to_the_bit():
    first, again = turned_around()[1], turn_around()[1]
    assert first.T_world_base.tobytes() == again.T_world_base.tobytes()
