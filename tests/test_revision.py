"""What modules correct afterwards reaches the whole trajectory."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.submaps.view_loops import ViewLoops
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import se3
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import BRIDGED
from sceneslam.types.trajectory import Trajectory

twists = st.lists(st.floats(-2, 2), min_size=6, max_size=6).map(np.array)


def drive(steps: int, twist: np.ndarray) -> np.ndarray:
    return np.stack([se3.exp(index * twist) for index in range(steps)])


def add_session(atlas, module, T_map_local, stamps_ns, poses):
    session = atlas.begin_session(module, T_map_local)
    for stamp_ns, T_local_base in zip(stamps_ns, poses, strict=True):
        atlas.add_local(stamp_ns, T_local_base)
        atlas.add(stamp_ns, T_map_local @ T_local_base, module)
        atlas.report(stamp_ns)
    return session


def test_a_run_that_nobody_revised_stays_as_it_was_told_to_the_bit():
    atlas = Atlas(voxel_m=0.05)
    T_map_local = se3.exp(np.array([1.0, 2.0, 0.3, 0.1, 0.2, 0.9]))
    session = add_session(atlas, "a", T_map_local, range(5), drive(5, np.full(6, 0.1)))
    atlas.close_session(session, MapLayers(), Trajectory.empty())
    np.testing.assert_array_equal(atlas.trajectory.T_world_base, atlas.online.T_world_base)


@given(twist=twists, error=twists, placed=twists)
def test_a_revised_session_carries_the_next_one_with_it(twist, error, placed):
    atlas = Atlas(voxel_m=0.05)
    true, T_map_local = drive(8, 0.1 * twist), se3.exp(placed)
    drifting = np.stack([T @ se3.exp(0.01 * i * error) for i, T in enumerate(true)])
    first = add_session(atlas, "a", T_map_local, range(5), drifting[:5])
    later = [se3.inverse(true[4]) @ T for T in true[5:]]
    T_map_next = T_map_local @ drifting[4]
    second = add_session(atlas, "b", T_map_next, range(5, 8), later)
    revised = Trajectory(stamps_ns=np.arange(5), T_world_base=true[:5])
    atlas.close_session(first, MapLayers(), revised)
    atlas.close_session(second, MapLayers(), Trajectory.empty())
    np.testing.assert_allclose(atlas.trajectory.T_world_base, T_map_local @ true, atol=1e-9)
    np.testing.assert_allclose(atlas.sessions[1].T_map_local, T_map_local @ true[4], atol=1e-9)
    np.testing.assert_allclose(atlas.online.T_world_base[:5], T_map_local @ drifting[:5])


@given(twist=twists, error=twists, placed=twists)
def test_a_session_starts_where_the_last_pose_ended_that_it_did_not_replace(twist, error, placed):
    """The first module is wrong from 3 on; a pose is bridged before the second and in it."""
    atlas = Atlas(voxel_m=0.05)
    true, T_map_local, T_new_told = drive(8, 0.1 * twist), se3.exp(placed), se3.exp(0.1 * error)
    wrong = [0.0, 0.01, 0.02, 1.0, 2.0]
    told = np.stack([true[i] @ se3.exp(w * error) for i, w in enumerate(wrong)])
    first = add_session(atlas, "a", T_map_local, range(5), told)
    atlas.rewind(3)
    T_map_bridged = T_map_local @ told[2] @ se3.inverse(true[2]) @ true[3]
    atlas.add(3, T_map_bridged, BRIDGED)
    T_map_next = T_new_told @ T_map_bridged
    second = atlas.begin_session("b", T_map_next, T_new_told)
    for stamp_ns in range(4, 8):
        T_local_base = se3.inverse(true[3]) @ true[stamp_ns]
        atlas.add(stamp_ns, T_map_next @ T_local_base, "b" if stamp_ns > 4 else BRIDGED)
        if stamp_ns > 4:
            atlas.add_local(stamp_ns, T_local_base)
    revised = Trajectory(stamps_ns=np.arange(5), T_world_base=true[:5])
    atlas.close_session(first, MapLayers(), revised)
    atlas.close_session(second, MapLayers(), Trajectory.empty())
    np.testing.assert_allclose(atlas.trajectory.T_world_base, T_map_local @ true, atol=1e-9)
    np.testing.assert_allclose(atlas.sessions[1].T_map_local, T_map_local @ true[3], atol=1e-9)


@given(twist=twists, error=twists, placed=twists)
def test_what_is_bridged_from_a_corrected_pose_is_corrected_once(twist, error, placed):
    """The module corrects its past twice, and its poses are replaced from 2, then from 3 on."""
    atlas = Atlas(voxel_m=0.05)
    true, T_map_local = drive(8, 0.1 * twist), se3.exp(placed)
    told = np.stack([T @ se3.exp(0.1 * i * error) for i, T in enumerate(true)])
    first = add_session(atlas, "a", T_map_local, range(4), told[:4])
    T_map_bridged, T_new_told = T_map_local @ told[1] @ se3.inverse(true[1]), se3.exp(0.1 * error)
    for begin, end in ((2, 4), (3, 5)):
        T_map_bridged = T_new_told @ T_map_bridged
        atlas.rewind(begin, T_new_told)
        for stamp_ns in range(begin, end):
            atlas.add(stamp_ns, T_map_bridged @ true[stamp_ns], BRIDGED)
    later = [se3.inverse(true[5]) @ T for T in true[5:]]
    second = add_session(atlas, "a", T_map_bridged @ true[5], range(5, 8), later)
    revised = Trajectory(stamps_ns=np.arange(4), T_world_base=true[:4])
    atlas.close_session(first, MapLayers(), revised)
    atlas.close_session(second, MapLayers(), Trajectory.empty())
    np.testing.assert_allclose(atlas.trajectory.T_world_base, T_map_local @ true, atol=1e-9)
    np.testing.assert_allclose(atlas.sessions[1].T_map_local, T_map_local @ true[5], atol=1e-9)


@given(twist=twists, error=twists, placed=twists)
def test_what_is_bridged_from_where_a_session_starts_is_corrected_once(twist, error, placed):
    """All poses of the second session are replaced, and it is placed anew."""
    atlas = Atlas(voxel_m=0.05)
    true, T_map_local, T_new_told = drive(8, 0.1 * twist), se3.exp(placed), se3.exp(0.1 * error)
    told = np.stack([T @ se3.exp(0.1 * i * error) for i, T in enumerate(true)])
    first = add_session(atlas, "a", T_map_local, range(3), told[:3])
    T_map_bridged = T_new_told @ T_map_local @ told[2] @ se3.inverse(true[2])
    atlas.begin_session("b", T_map_bridged @ true[3], T_new_told)
    atlas.add(3, T_map_bridged @ true[3] @ se3.exp(error), "b")
    atlas.rewind(3, T_new_told)
    atlas.add(3, T_map_bridged @ true[3], BRIDGED)
    later = [se3.inverse(true[4]) @ T for T in true[4:]]
    add_session(atlas, "b", T_map_bridged @ true[4], range(4, 8), later)
    revised = Trajectory(stamps_ns=np.arange(3), T_world_base=true[:3])
    atlas.close_session(first, MapLayers(), revised)
    np.testing.assert_allclose(atlas.trajectory.T_world_base, T_map_local @ true, atol=1e-9)
    for session, start in ((1, 3), (2, 4)):
        T_map_start = atlas.sessions[session].T_map_local
        np.testing.assert_allclose(T_map_start, T_map_local @ true[start], atol=1e-9)


def test_a_bridged_pose_moves_with_the_revised_pose_before_it():
    atlas = Atlas(voxel_m=0.05)
    session = add_session(atlas, "a", se3.identity(), [0, 1], [se3.identity()] * 2)
    atlas.add(2, se3.from_xy_yaw(1.0, 0.0, 0.0), BRIDGED)
    turned = np.stack([se3.identity(), se3.from_xy_yaw(0.0, 0.0, np.pi / 2)])
    revised = Trajectory(stamps_ns=np.arange(2), T_world_base=turned)
    atlas.close_session(session, MapLayers(), revised)
    np.testing.assert_allclose(atlas.trajectory.positions_m[2], [0.0, 1.0, 0.0], atol=1e-12)


def test_poses_that_a_revision_leaves_out_move_with_the_one_before():
    atlas = Atlas(voxel_m=0.05)
    session = add_session(atlas, "a", se3.identity(), [0, 1, 2], drive(3, np.eye(6)[0]))
    shifted = se3.from_xy_yaw(0.0, 3.0, 0.0)[None]
    revised = Trajectory(stamps_ns=np.array([1]), T_world_base=shifted)
    atlas.close_session(session, MapLayers(), revised)
    np.testing.assert_allclose(atlas.trajectory.positions_m, [[0, 0, 0], [0, 3, 0], [1, 3, 0]])


def test_a_session_starts_where_the_one_before_it_ended_whatever_its_module_revises():
    atlas = Atlas(voxel_m=0.05)
    poses = drive(4, np.array([1.0, 0, 0, 0, 0, 0.2]))
    first = add_session(atlas, "a", se3.identity(), [0, 1], poses[:2])
    second = add_session(atlas, "b", se3.identity(), [2, 3], poses[2:])
    atlas.close_session(first, MapLayers(), Trajectory.empty())
    shift = se3.exp(np.array([3.0, 2.0, 0.1, 0.0, 0.1, 0.7]))
    revised = Trajectory(stamps_ns=np.array([2, 3]), T_world_base=shift @ poses[2:])
    atlas.close_session(second, MapLayers(), revised)
    np.testing.assert_allclose(atlas.trajectory.T_world_base, poses, atol=1e-9)
    np.testing.assert_allclose(atlas.sessions[1].T_map_local, se3.inverse(shift), atol=1e-9)


def seen_again(true):
    """Loops as a camera measures them, from the first session to the third."""

    def loops_to(_, query):
        starts = [int(submap.stamps_ns[0]) // 10**9 for submap in query.submaps]
        return [
            Edge(
                first=first,
                second=query.second,
                T_first_second=se3.inverse(true[starts[first]]) @ true[starts[query.second]],
                covariance=0.005**2 * np.eye(6),
                kind=EdgeKind.LOOP,
            )
            for first in range(query.second)
            if (query.submaps[first].session, query.submap.session) == (0, 2)
        ], ()

    return loops_to


def test_a_loop_between_sessions_puts_right_what_drifted_between_them(monkeypatch):
    atlas, rig = Atlas(voxel_m=0.05), Rig(sensors=frozenset({Sensor.ODOMETRY}))
    atlas.open(rig, lambda *_, **__: None)
    turn = se3.exp(np.array([0.2, 0, 0, 0, 0, 0.02 * np.pi]))  # 100 steps around a circle
    slow = turn @ se3.exp(np.array([0.002, 0, 0.002, 0, 0.0002, 0.0006]))
    true, told = [se3.identity()], [se3.identity()]
    for step in range(1, 121):
        true.append(true[-1] @ turn)
        told.append(told[-1] @ (slow if 10 <= step < 100 else turn))
    monkeypatch.setattr(ViewLoops, "loops_to", seen_again(true))
    stamp = lambda step: step * 10**9  # noqa: E731
    for number, (first, last) in enumerate(((0, 10), (10, 100), (100, 121))):
        atlas.begin_session("ab"[number % 2], told[first])
        for step in range(first, last):
            atlas.add_local(stamp(step), se3.inverse(told[first]) @ told[step])
            atlas.add(stamp(step), told[step], "ab"[number % 2])
            atlas.observe(Observation(stamp_ns=stamp(step)), None)
    for number in range(3):
        atlas.close_session(number, MapLayers(), Trajectory.empty())
    assert atlas.finish() == []
    before, after = (
        np.linalg.norm(found - np.array(true)[:, :3, 3], axis=1)
        for found in (np.array(told)[:, :3, 3], atlas.trajectory.positions_m)
    )
    assert before.max() > 0.2 and after.max() < 0.25 * before.max()
    assert after[-20:].max() < 0.02 and after[:10].max() < 0.02
    apart_m = np.linalg.norm(np.diff(atlas.trajectory.positions_m, axis=0), axis=1)
    assert apart_m.max() < 0.24  # no jump at a seam


def test_a_module_that_returns_without_knowing_its_place_moves_nothing():
    atlas = Atlas(voxel_m=0.05)
    for index, module in enumerate("aba"):
        T_map_local = se3.exp(np.full(6, 0.3 * index))
        stamps_ns = range(3 * index, 3 * index + 3)
        session = add_session(atlas, module, T_map_local, stamps_ns, drive(3, np.full(6, 0.1)))
        atlas.close_session(session, MapLayers(), Trajectory.empty())
    np.testing.assert_array_equal(atlas.trajectory.T_world_base, atlas.online.T_world_base)
