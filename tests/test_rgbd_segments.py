"""A camera that is lost for good begins a new part of the map, and joins it when they meet."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from test_rgbd import make

from sceneslam.modules.slam.rgbd.loops.pose_graph import PoseGraph
from sceneslam.modules.slam.rgbd.map.segments import Segments
from sceneslam.testing.room import observation_at
from sceneslam.types import se3
from sceneslam.types.observation import TrackingStatus

RATE_HZ, TURN_RAD = 15.0, 0.06
SEEN, GAP_S, AWAY_RAD = 12, 2.0, 2.2
IMAGES = 88  # the last twenty or so of which show again what the first did


def pose(index):
    """Look to and fro at one side of the room; be carried away; turn back from there."""
    if index < SEEN:
        return se3.from_xy_yaw(0.02 * index, 0.0, TURN_RAD * index - 0.3)
    step = max(0, index - SEEN - int(1.2 * RATE_HZ))
    return se3.from_xy_yaw(0.1 + 0.005 * step, 0.3, AWAY_RAD - TURN_RAD * step)


def by_camera(T_room_base, time_s):
    one = observation_at(T_room_base, time_s)
    return replace(one, scan=None, points_lidar=None, T_odom_base=None, gyro_base=None)


@cache
def images():
    """Observations of a camera alone, two seconds of which were cut out."""
    seen = []
    for index in range(IMAGES):
        time_s = index / RATE_HZ + (GAP_S if index >= SEEN else 0.0)
        seen.append(by_camera(pose(index), time_s))
    return seen


@cache
def turn():
    """Observations of a camera alone that turns once around."""
    return [by_camera(se3.from_xy_yaw(0.0, 0.0, 0.09 * i), i / RATE_HZ) for i in range(70)]


def error_m(T_local_base, index):
    T_error = se3.inverse(se3.inverse(pose(0)) @ pose(index)) @ T_local_base
    return float(np.linalg.norm(T_error[:3, 3]))


@pytest.fixture(scope="module")
def kidnapped():
    pytest.importorskip("gtsam")
    module = make()
    answers = [module.track(image) for image in images()]
    revised, layers = module.get_trajectory(), module.get_map()
    module.shutdown()
    return answers, revised, layers


def test_lost_camera_goes_on_after_its_patience_and_says_that_it_guesses(kidnapped):
    answers, _, _ = kidnapped
    status = [answer.status for answer in answers]
    back = next(i for i in range(SEEN, IMAGES) if status[i] is not TrackingStatus.LOST)
    assert status[SEEN] is TrackingStatus.LOST
    assert status[back] is TrackingStatus.DEGRADED and answers[back].revision == 0
    told = answers[back + 3]
    assert told.status is TrackingStatus.DEGRADED
    assert np.sqrt(told.covariance[0, 0]) > GAP_S * 0.9


def test_segments_are_joined_where_they_meet(kidnapped):
    answers, revised, layers = kidnapped
    assert answers[-1].status is TrackingStatus.TRACKING and answers[-1].revision >= 1
    assert error_m(answers[-1].T_local_base, len(answers) - 1) < 0.03
    indices = [i for i, a in enumerate(answers) if a.status is not TrackingStatus.LOST]
    assert len(revised) == len(indices)
    errors = [error_m(T, i) for T, i in zip(revised.T_world_base, indices, strict=True)]
    assert max(errors) < 0.06
    assert layers.pose_graph.is_loop.any()


def test_pose_jumps_to_where_the_camera_is_only_where_a_revision_says_so(kidnapped):
    answers, _, _ = kidnapped
    held = [answer for answer in answers if answer.status is not TrackingStatus.LOST]
    for one, other in pairwise(held):
        jump_m = np.linalg.norm((se3.inverse(one.T_local_base) @ other.T_local_base)[:3, 3])
        assert jump_m < 0.1 or other.revision > one.revision


def test_camera_that_comes_back_in_time_begins_nothing():
    module = make()
    for image in images()[:SEEN]:
        module.track(image)
    back = replace(images()[SEEN // 2], stamp_ns=images()[SEEN].stamp_ns)
    answer = module.track(back)
    module.shutdown()
    assert answer.status is TrackingStatus.TRACKING
    assert error_m(answer.T_local_base, SEEN // 2) < 0.03


@pytest.mark.parametrize("keyframe_limit", [3, 5, 8, 12])
def test_map_of_two_segments_that_is_full_goes_on(keyframe_limit):
    """Keyframes are removed from either segment, and the last one of a segment, too."""
    module = make(keyframe_limit=keyframe_limit)
    answers = [module.track(image) for image in images()]
    revised, layers = module.get_trajectory(), module.get_map()
    module.shutdown()
    held = [answer.stamp_ns for answer in answers if answer.status is not TrackingStatus.LOST]
    assert revised.stamps_ns.tolist() == held
    assert len(layers.pose_graph.stamps_ns) == keyframe_limit


@pytest.mark.parametrize("keyframe_limit", [3, 5, 8])
def test_keyframes_of_a_full_map_stay_connected(keyframe_limit):
    """One that is removed may be all that the newest one was seen with."""
    module = make(keyframe_limit=keyframe_limit, keyframe_step_m=0.05)
    for image in turn():
        module.track(image)
    graph = module.get_map().pose_graph
    module.shutdown()
    first, second = graph.edges.T
    reached = np.zeros(len(graph.stamps_ns), bool)
    reached[0] = True
    for _ in reached:
        reached[first[reached[second]]] = reached[second[reached[first]]] = True
    assert len(reached) == keyframe_limit and reached.all()


def test_what_a_guess_costs_lies_where_the_map_has_its_keyframe_now():
    """A turn that may be 2 rad off, seen from 3 m away, after the map moved by 1 m."""
    graph, keyframes = PoseGraph(), {}
    for k in range(2):
        graph.insert(k)
        keyframes[k] = SimpleNamespace(T_local_base=se3.from_xy_yaw(float(k), 0.0, 0.0))
    segments = Segments(graph, keyframes)
    segments.begin(1, lost_s=1.0)
    spread_m2 = [
        segments.covariance({1}, se3.from_xy_yaw(x_m, 0.0, 0.0), np.zeros((6, 6)))[1, 1]
        for x_m in (1.0, 4.0)
    ]
    for keyframe in keyframes.values():
        keyframe.T_local_base = se3.from_xy_yaw(1.0, 0.0, 0.0) @ keyframe.T_local_base
    moved_m2 = segments.covariance({1}, se3.from_xy_yaw(5.0, 0.0, 0.0), np.zeros((6, 6)))[1, 1]
    assert moved_m2 == pytest.approx(spread_m2[1]) and spread_m2[1] > 2.0 * spread_m2[0]
