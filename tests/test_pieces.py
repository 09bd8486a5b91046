"""A robot that was carried to somewhere else: both pieces become one map where it comes back."""

from dataclasses import replace

import numpy as np
import pytest
from planar_poses import transforms
from test_laser_loop import PERIOD_NS, STEP_M, VIEW, furnished, laps, settings
from test_laser_world import box, corridor, drive

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting.map_files import read_map_files
from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.types import se3
from sceneslam.types.covariance import unknown_motion
from sceneslam.types.maps import MapLayers
from sceneslam.types.rig import Laser, Rig, Sensor, Wheels
from sceneslam.types.run import BRIDGED
from sceneslam.types.trajectory import Trajectory

RIG = Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())
LOST_S = 10.0


def carried(walls, *paths, **lasting):
    """Return atlas and loops after paths (x, y, yaw); nothing was measured between two of them."""
    atlas, loops = Atlas(voxel_m=0.05, **lasting), []
    atlas.open(RIG, lambda event, stamp_ns, **more: event == "loop" and loops.append(more))
    T_map_base, start_ns = se3.identity(), 0
    for number, path in enumerate(paths):
        lost_s = LOST_S if number else 0.0
        start_ns += round(lost_s * 1e9)
        module = LaserSlam(**settings())
        module.activate(RIG)
        rng = np.random.default_rng(3)
        seen = drive(walls, path, odometry=path, rng=rng, period_ns=PERIOD_NS, **VIEW)
        session, T_map_local = atlas.begin_session("laser", T_map_base), T_map_base
        for one in seen:
            answer = module.track(one)
            stamp_ns, T_local_base = start_ns + one.stamp_ns, answer.T_local_base
            unknown = se3.carried(unknown_motion(lost_s), se3.inverse(T_local_base))
            T_map_base = T_map_local @ T_local_base
            atlas.add_local(stamp_ns, T_local_base)
            atlas.add(
                stamp_ns, T_map_base, "laser", answer.covariance, answer.map_covariance + unknown
            )
            atlas.observe(_at(one, stamp_ns), None)
        start_ns = stamp_ns + PERIOD_NS
        atlas.close_session(session, MapLayers(), Trajectory.empty())
    assert atlas.finish() == []
    return atlas, loops


def _at(observation, stamp_ns):
    scan = replace(observation.scan, stamp_ns=stamp_ns)
    return replace(observation, stamp_ns=stamp_ns, scan=scan)


def errors_m(atlas, path):
    """Return how far each pose is off, in the frame of the first."""
    T_true = transforms(path)
    T_true = se3.inverse(T_true[0]) @ T_true
    return np.linalg.norm((atlas.trajectory.T_world_base - T_true)[:, :3, 3], axis=1)


@pytest.mark.parametrize("turned", [False, True])
def test_pieces_are_joined_where_the_robot_comes_back(turned):
    path, lap = laps(2), len(laps(1))
    first, second = path[: lap // 2], path[lap // 4 + lap // 2 : lap + lap // 2]
    if turned:  # it comes back the other way round
        second = second[::-1]
    atlas, loops = carried(furnished(np.random.default_rng(0)), first, second)
    assert loops
    errors = errors_m(atlas, np.concatenate([first, second]))
    assert errors.max() < 0.3  # the first piece alone drifts by 0.24 m
    sigmas = np.sqrt(np.diagonal(atlas.covariances(Wheels()), axis1=1, axis2=2))
    assert sigmas[-1, [0, 1, 5]].max() < 0.1 and sigmas.max() < 0.2 * LOST_S


@pytest.fixture(scope="module")
def ring_map(tmp_path_factory):
    """A map of the ring, saved by a run of one lap, and the ring."""
    folder, walls = tmp_path_factory.mktemp("ring") / "map", furnished(np.random.default_rng(0))
    carried(walls, laps(1), save=str(folder))
    return folder, walls


@pytest.mark.parametrize("from_share", [0.25, 0.5])
def test_in_a_loaded_map_every_piece_is_found_and_none_moves_another(ring_map, from_share):
    folder, walls = ring_map
    path, lap = laps(2), len(laps(1))
    start = round((1.0 + from_share) * lap)
    first, second = path[: lap // 2], path[start : start + lap // 2]
    atlas, loops = carried(walls, first, second, load=str(folder))
    assert any(loop["in_loaded_map"] for loop in loops)
    T_true = transforms(np.concatenate([first, second]))
    T_true = se3.inverse(T_true[0]) @ T_true  # the loaded map begins there, too
    off_m = np.linalg.norm((atlas.trajectory.T_world_base - T_true)[:, :3, 3], axis=1)
    assert off_m.max() < 0.4  # the map is off by 0.3 m
    online = atlas.online.T_world_base
    late_m = np.linalg.norm((online - T_true)[:, :3, 3], axis=1)[len(first) + 95 :]
    assert late_m.max() < 0.4  # it was found within 9.5 s


def test_pieces_that_nothing_joins_are_saved_as_pieces_the_largest_first(tmp_path):
    walls, path, lap = furnished(np.random.default_rng(0)), laps(1), len(laps(1))
    first, second = path[: lap // 6], path[lap // 2 : lap]
    _, loops = carried(walls, first, second, save=str(tmp_path / "map"))
    saved, _ = read_map_files(tmp_path / "map")
    assert not loops
    later = [one.stamps_ns[0] > int(LOST_S * 1e9) for one in saved.submaps]
    assert 0 < later.index(True) < len(later) / 2 and list(saved.pieces) == [not x for x in later]
    assert all(saved.pieces[edge.first] == saved.pieces[edge.second] for edge in saved.edges)


def test_pieces_stay_apart_where_places_look_alike():
    """A corridor that repeats itself every metre, and shows no end."""
    boxes = [box(x - 0.15, 0.85, x + 0.15, 1.15) for x in range(-20, 80)]
    walls = np.concatenate([corridor(), *boxes])
    ahead = np.array([(STEP_M * step, 0.0, 0.0) for step in range(80)])
    atlas, loops = carried(walls, ahead, ahead + np.array([30.0, 0.0, 0.0]))
    assert not loops
    sigmas = np.sqrt(np.diagonal(atlas.covariances(Wheels()), axis1=1, axis2=2))
    assert sigmas[-1, :2].min() > 0.9 * LOST_S


def test_a_loop_is_believed_if_another_has_its_ends_in_the_same_pieces():
    graph, cov = RunGraph(empty_map(), lambda session: False), np.diag(np.full(6, 1e-4))
    graph._starts = frozenset([0, 10])
    within, beside, later, across, again = (
        Edge(first=a, second=b, T_first_second=np.eye(4), covariance=cov, kind=EdgeKind.LOOP)
        for a, b in ((0, 5), (1, 6), (11, 17), (2, 15), (3, 16))
    )
    assert graph._believed([within, beside, across]) == [within, beside]
    assert graph._believed([within, across, again]) == [across, again]
    assert graph._believed([within, later]) == graph._believed([within, across]) == []
    assert graph._believed([within]) == graph._believed([across]) == []


def test_a_piece_begins_where_its_module_answered_though_poses_were_guessed_before(
    monkeypatch, tmp_path
):
    """The bus tells poses bridged at constant velocity with the session that they lead to."""
    add, begun = Atlas.add, dict[int, int]()

    def bridged_first(atlas, stamp_ns, T_map_base, module, covariance, map_covariance):
        session = len(atlas._sessions) - 1
        begun.setdefault(session, stamp_ns)
        if session and stamp_ns < begun[session] + 5 * PERIOD_NS:
            module, covariance, map_covariance = BRIDGED, None, None
        add(atlas, stamp_ns, T_map_base, module, covariance, map_covariance)

    monkeypatch.setattr(Atlas, "add", bridged_first)
    walls, path = furnished(np.random.default_rng(0)), laps(1)
    lap = len(path)
    carried(walls, path[: lap // 6], path[lap // 2 :], save=str(tmp_path / "map"))
    saved, _ = read_map_files(tmp_path / "map")
    assert len(np.unique(saved.pieces)) == 2
