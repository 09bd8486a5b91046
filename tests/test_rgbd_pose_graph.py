"""The pose graph spreads a loop's error by what was measured; frames move with their keyframes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.graphs.factors import fit
from sceneslam.modules.slam.frame_log import FrameLog
from sceneslam.modules.slam.rgbd.loops.pose_graph import PoseGraph
from sceneslam.types import se3

TWISTS = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6).map(np.array)


def edge(first, second, T_first_second, sigma=0.01, is_loop=False):
    return Edge(
        first=first,
        second=second,
        T_first_second=T_first_second,
        covariance=sigma**2 * np.eye(6),
        kind=EdgeKind.LOOP if is_loop else EdgeKind.MOTION,
    )


def chain(count, step=None):
    """Keyframes a metre apart, each measured from the one before it."""
    step = se3.from_xy_yaw(1.0, 0.0, 0.0) if step is None else step
    graph = PoseGraph()
    for keyframe_id in range(count):
        graph.insert(keyframe_id)
        if keyframe_id:
            graph.connect(edge(keyframe_id - 1, keyframe_id, step))
    return graph


@given(TWISTS, TWISTS)
def test_edge_turned_twice_is_itself_and_edges_add_up(first, second):
    one = edge(0, 1, se3.exp(first))
    other = edge(1, 2, se3.exp(second))
    back = one.turned().turned()
    np.testing.assert_allclose(back.T_first_second, one.T_first_second, atol=1e-9)
    np.testing.assert_allclose(back.covariance, one.covariance, atol=1e-9)
    # The way back of the whole is the ways back of its parts.
    whole, parts = one.then(other).turned(), other.turned().then(one.turned())
    np.testing.assert_allclose(whole.T_first_second, parts.T_first_second, atol=1e-9)
    np.testing.assert_allclose(whole.covariance, parts.covariance, atol=1e-9)


def test_covariance_of_a_turned_edge_is_that_of_turned_measurements():
    rng = np.random.default_rng(0)
    sigmas = np.array([0.01, 0.02, 0.03, 0.01, 0.02, 0.005])
    T = se3.exp(np.array([1.0, -2.0, 0.5, 0.4, 0.8, -0.3]))
    turned = Edge(first=0, second=1, T_first_second=T, covariance=np.diag(sigmas**2)).turned()
    samples = [
        se3.log(T @ se3.inverse(T @ se3.exp(sigmas * rng.standard_normal(6)))) for _ in range(4000)
    ]
    ratio = np.diag(np.cov(np.array(samples).T)) / np.diag(turned.covariance)
    assert ratio == pytest.approx(np.ones(6), abs=0.12)


def test_loop_moves_what_was_measured_least():
    pytest.importorskip("gtsam")
    graph = chain(6)
    graph.connect(edge(2, 3, se3.from_xy_yaw(1.0, 0.0, 0.0), sigma=0.3))
    graph.connect(edge(0, 5, se3.from_xy_yaw(5.4, 0.0, 0.0), is_loop=True))
    straight = {k: se3.from_xy_yaw(float(k), 0.0, 0.0) for k in range(6)}
    x_m = [T[0, 3] for T in fit(straight, graph.edges, held=0, huber_sigmas=1.345).values()]
    assert np.diff(x_m) == pytest.approx([1, 1, 1.4, 1, 1], abs=0.01)


def test_wrong_loop_of_fifteen_metres_bends_the_map_by_decimetres_at_most():
    pytest.importorskip("gtsam")
    graph = chain(20)
    for start in range(0, 12, 2):
        graph.connect(edge(start, start + 8, se3.from_xy_yaw(8.0, 0.0, 0.0), is_loop=True))
    graph.connect(edge(1, 18, se3.from_xy_yaw(2.0, 3.0, 1.0), is_loop=True))
    straight = {k: se3.from_xy_yaw(float(k), 0.0, 0.0) for k in range(20)}
    solved = fit(straight, graph.edges, held=0, huber_sigmas=1.345)
    assert max(np.linalg.norm(solved[k][:3, 3] - straight[k][:3, 3]) for k in straight) < 0.25


def test_keyframes_stay_connected_when_those_between_them_are_forgotten():
    graph = chain(9, step=se3.from_xy_yaw(0.8, 0.1, 0.2))
    before = graph.way(0, 8)
    for keyframe_id in (4, 3, 6, 7, 1):
        graph.remove(keyframe_id)
    assert graph.connected(0) == {0, 2, 5, 8}
    assert len(graph.edges) == 3
    T_0_8 = se3.identity()
    for one in sorted(graph.edges, key=lambda e: e.first):
        T_0_8 = T_0_8 @ one.T_first_second
    expected = np.linalg.matrix_power(se3.from_xy_yaw(0.8, 0.1, 0.2), 8)
    np.testing.assert_allclose(T_0_8, expected, atol=1e-9)
    after = graph.way(0, 8)
    assert after.turned_rad == pytest.approx(before.turned_rad)
    assert after.reach_m == pytest.approx(before.reach_m)
    assert graph.way(0, 8).sigma_rad == pytest.approx(before.sigma_rad)


def test_removed_keyframe_of_a_loop_leaves_motions_and_one_loop():
    graph = chain(6)
    graph.connect(edge(0, 4, se3.from_xy_yaw(4.0, 0.0, 0.0), sigma=0.001, is_loop=True))
    assert graph.remove(4).first == 5
    kinds = {(e.first, e.second): e.is_loop for e in graph.edges}
    motions = dict.fromkeys([(0, 1), (1, 2), (2, 3), (3, 5)], False)
    assert kinds == motions | {(0, 5): True}


def test_graph_does_not_grow_when_every_new_keyframe_drives_out_an_old_one():
    graph, step = chain(30), se3.from_xy_yaw(1.0, 0.0, 0.0)
    for keyframe_id in range(30, 200):
        graph.insert(keyframe_id)
        for back in (1, 2, 3):
            start = graph.ids[-1 - back]
            graph.connect(edge(start, keyframe_id, step))
        graph.remove(graph.ids[keyframe_id % 20])
    assert len(graph.ids) == 30
    assert len(graph.edges) < 150


def test_no_way_leads_to_what_nothing_was_measured_to():
    graph = chain(3)
    graph.insert(9)
    assert graph.way(0, 9) is None and graph.connected(9) == {9}


@given(TWISTS, TWISTS)
def test_frames_move_with_their_keyframe_and_stay_when_it_is_forgotten(moved, offset):
    frames, T_old, T_heir = FrameLog(), se3.exp(moved), se3.exp(offset)
    for index in range(1100):  # more than the first capacity
        frames.add(index, 7, se3.from_xy_yaw(0.001 * index, 0.0, 0.0), np.zeros(6))
    before = frames.trajectory({7: T_old})
    assert len(before) == 1100
    np.testing.assert_allclose(before.T_world_base[0], T_old, atol=1e-9)
    frames.hand_over(7, 3, se3.inverse(T_heir) @ T_old)
    after = frames.trajectory({3: T_heir})
    np.testing.assert_allclose(after.T_world_base, before.T_world_base, atol=1e-9)
    assert not len(frames.trajectory({7: T_old}))


@given(TWISTS, TWISTS, TWISTS)
def test_frame_moves_by_its_own_turn_when_reading_takes_longer(moved, of_keyframe, of_frame):
    frames, T_local_keyframe, T_local_base = FrameLog(), se3.exp(moved), se3.exp(moved / 2)
    frames.add(0, 7, se3.inverse(T_local_keyframe) @ T_local_base, of_frame)
    frames.straighten(0.02, {7: of_keyframe})
    told = frames.trajectory({7: T_local_keyframe @ se3.exp(0.02 * of_keyframe)})
    expected = T_local_base @ se3.exp(0.02 * of_frame)
    np.testing.assert_allclose(told.T_world_base[0], expected, atol=1e-9)
    assert frames.newest[0] == 7
