"""A loop needs depth, odometry that does not contradict it, and keyframes that are still there."""

from types import SimpleNamespace

import numpy as np
import pytest

from sceneslam.graphs.edge import Edge
from sceneslam.modules.slam.rgbd.loops.loop_detection import LoopClosure, LoopDetector, Query
from sceneslam.modules.slam.rgbd.loops.pose_graph import PoseGraph
from sceneslam.modules.slam.rgbd.map.keyframes import OdometryPose
from sceneslam.types import se3

TURN_RAD = 0.002  # standard deviation of odometry's turn from keyframe to keyframe


def keyframe(index, *, stretch=0):
    odometry = OdometryPose(
        T_odom_base=se3.from_xy_yaw(0.3 * index, 0.0, 0.0),
        stretch=stretch,
        variance=index * np.array([0.01**2, TURN_RAD**2]),
    )
    T_local_base = se3.from_xy_yaw(0.3 * index, 0.0, 0.0)
    return SimpleNamespace(T_local_base=T_local_base, odometry=odometry, features=None)


def loops(off_rad, *, stretch=0, gone=None):
    """Return the loops of two keyframes that both recognize an old one, turned by `off_rad`.

    The keyframe `gone` is removed from the map between the two.
    """
    keyframes = {k: keyframe(k, stretch=stretch * (k > 0)) for k in range(3)}
    keyframes[-1] = keyframes[0]  # of the same place
    graph = PoseGraph()
    for k in keyframes:
        graph.insert(k)

    def recognize(candidate, features, depth_m):
        T_local_base = se3.from_xy_yaw(0.0, 0.0, off_rad) @ keyframes[recognized].T_local_base
        estimate = SimpleNamespace(T_local_base=T_local_base, covariance=1e-8 * np.eye(6))
        return SimpleNamespace(estimate=estimate)

    visual_map = SimpleNamespace(keyframes=keyframes)
    detector = LoopDetector(visual_map, SimpleNamespace(recognize=recognize), graph)
    found = []
    for recognized in (1, 2):
        found = detector.check(Query(keyframe_id=recognized, depth_m=None), 1 - recognized)
        if gone in graph:
            graph.remove(gone)
    return found


@pytest.mark.parametrize(
    ("off_rad", "stretch", "count"),
    [(0.0, 0, 2), (0.03, 0, 2), (0.06, 0, 0), (0.06, 1, 2)],
    ids=["as measured", "within its deviation", "too far", "odometry had a gap"],
)
def test_loop_turns_as_odometry_measured(off_rad, stretch, count):
    assert len(loops(off_rad, stretch=stretch)) == count


@pytest.mark.parametrize(("gone", "count"), [(0, 0), (1, 0), (None, 2)])
def test_a_loop_is_forgotten_whose_keyframe_was_removed(gone, count):
    assert len(loops(0.0, gone=gone)) == count


class Store(dict):
    """Keyframes of which none shares a landmark with another."""

    ids = property(lambda self: list(self))

    def covisible(self, landmark_ids, *, limit):
        return []


@pytest.mark.parametrize(
    ("monocular", "expected"),
    [
        ([False] * 8, 0),
        ([True] * 8, 0),
        ([False] * 7 + [True], None),
        ([True, False] + [True] * 5 + [False], 1),
    ],
    ids=["all with depth", "a camera without", "the newest without", "the oldest without"],
)
def test_depth_verifies_a_loop_where_there_ever_was_any(monocular, expected):
    features = SimpleNamespace(descriptors=None)
    keyframes = Store(
        (k, SimpleNamespace(is_monocular=one, features=features, landmark_ids=None))
        for k, one in enumerate(monocular)
    )

    def alike(descriptors, ids):
        return [SimpleNamespace(place_id=k, ratio=0.5) for k in ids]

    recognizer = SimpleNamespace(places=SimpleNamespace(alike=alike))
    detector = LoopDetector(SimpleNamespace(keyframes=keyframes), recognizer, PoseGraph())
    assert detector.candidate(Query(keyframe_id=7, depth_m=None)) == expected


@pytest.mark.parametrize("turn_rad", [0.0, np.pi / 4, np.pi / 2])
def test_two_right_loops_agree_however_the_camera_turned_between_them(turn_rad):
    """Each is vague along its own line of sight: far landmarks have vague depth."""
    rng, covariance = np.random.default_rng(0), np.diag([0.05, *[0.005] * 2, *[0.003] * 3]) ** 2
    poses = {1: np.eye(4), 2: se3.from_xy_yaw(0.3, 0.0, turn_rad)}
    keyframes = {k: SimpleNamespace(T_local_base=T) for k, T in poses.items()}
    detector = LoopDetector(SimpleNamespace(keyframes=keyframes), None, PoseGraph())

    def loop(k):
        T = poses[k] @ se3.exp(rng.multivariate_normal(np.zeros(6), covariance))
        edge = Edge(first=0, second=k, T_first_second=T, covariance=covariance)
        return LoopClosure(edge=edge, T_local_base=T)

    assert sum(detector._agree(loop(1), loop(2)) for _ in range(200)) >= 195
