"""Loops of the laser module: driven round a ring of corridors with wheels that turn too much."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_laser_world import box, drive, loop_path, room, scan_at

from sceneslam.modules.slam.laser.field import LikelihoodField
from sceneslam.modules.slam.laser.loop_search import LoopSearch
from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.modules.slam.laser.pose_graph import ScanEdge, ScanPoseGraph, optimise
from sceneslam.modules.slam.laser.surface import ScanSurfaceReader
from sceneslam.types import se3
from sceneslam.types.planar import between, betweens, compose, composed
from sceneslam.types.rig import Laser, Rig, Sensor

PERIOD_NS = 100_000_000
STEP_M = 0.15
CORNERS = np.array([[0.0, 0.0], [14.0, 0.0], [14.0, 8.0], [0.0, 8.0]])
VIEW = {"fov_rad": np.pi, "beams": 90, "range_max_m": 4.0}


def ring(boxes):
    """Return corridors of 3 m around a block, with boxes (x, y, half size) standing in them."""
    walls = [box(-1.5, -1.5, 15.5, 9.5), box(1.5, 1.5, 12.5, 6.5)]
    return np.concatenate(walls + [box(x - h, y - h, x + h, y + h) for x, y, h in boxes])


def furnished(rng):
    """Return a ring whose every stretch looks different."""
    places = [(x, y) for x in np.arange(0.5, 14.0, 1.3) for y in (-1.5, 9.5)]
    return ring([(x + rng.uniform(-0.5, 0.5), y, rng.uniform(0.1, 0.4)) for x, y in places])


def alike():
    """Return a ring whose corridors repeat themselves every metre."""
    return ring([(float(x), y, 0.15) for x in range(-1, 16) for y in (-1.5, 9.5)])


def laps(count):
    """Return a path (x, y, yaw) round the ring, turning on the spot at its corners."""
    poses = []
    for side in range(4 * count):
        start, end = CORNERS[side % 4], CORNERS[(side + 1) % 4]
        yaw = side * np.pi / 2
        steps = round(np.linalg.norm(end - start) / STEP_M)
        shares = np.arange(steps) / steps
        poses += [(*(start + share * (end - start)), yaw) for share in shares]
        poses += [(*end, yaw + turn) for turn in np.linspace(0.15, np.pi / 2 - 0.05, 10)]
    return np.array(poses)


def slipping(path, turn_rad_per_m):
    """Return what wheels say that turn a little with every metre."""
    motions = betweens(path[:-1], path[1:])
    motions[:, 2] += turn_rad_per_m * np.hypot(motions[:, 0], motions[:, 1])
    poses = [path[0]]
    for motion in motions:
        poses.append(compose(poses[-1], motion))
    return np.array(poses)


def settings():
    conf = Path(__file__).resolve().parent.parent / "conf/slam/laser.yaml"
    values = yaml.safe_load(conf.read_text())
    values.pop("_target_")
    return values


def run(walls, path):
    """Return the module after the drive, and what it told."""
    module = LaserSlam(**settings())
    module.activate(Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()))
    observations = drive(
        walls,
        path,
        odometry=slipping(path, 0.03),
        rng=np.random.default_rng(3),
        period_ns=PERIOD_NS,
        **VIEW,
    )
    return module, [module.track(observation) for observation in observations]


def laps_apart_m(T_local_base):
    """Return how far the second lap's positions are from the first's, where they are the same."""
    positions = T_local_base[:, :2, 3]
    half = len(positions) // 2
    return np.linalg.norm(positions[half:] - positions[:half], axis=1)


def loop_errors_m(path, graph):
    """Return how far each loop is from the truth."""
    rows = graph.stamps_ns // PERIOD_NS
    first, second = rows[graph.edges[graph.is_loop]].T
    truth = betweens(path[first], path[second])
    measured = graph.T_from_to[graph.is_loop][:, :2, 3]
    return np.linalg.norm(measured - truth[:, :2], axis=1)


@pytest.fixture(scope="module")
def two_laps():
    path = laps(2)
    module, trackings = run(furnished(np.random.default_rng(1)), path)
    return path, module, trackings, module.get_trajectory()


def test_second_lap_closes_loops_that_are_right(two_laps):
    path, module, _, _ = two_laps
    off_m = loop_errors_m(path, module.get_map().pose_graph)
    assert len(off_m) > 8
    assert off_m.max() < 0.1


def test_revised_laps_lie_on_each_other_where_those_told_had_drifted_apart(two_laps):
    path, _, trackings, revised = two_laps
    told = np.stack([tracking.T_local_base for tracking in trackings])
    assert len(revised) == len(path)
    revised_m, told_m = (laps_apart_m(T).mean() for T in (revised.T_world_base, told))
    assert revised_m < 0.02 < told_m


def test_corrections_are_announced_when_the_pose_jumps(two_laps):
    path, _, trackings, _ = two_laps
    revisions = np.array([tracking.revision for tracking in trackings])
    assert (np.diff(revisions) >= 0).all()
    assert revisions[len(path) // 2] == 0 < revisions[-1]
    told = np.stack([tracking.T_local_base for tracking in trackings])
    steps_m = np.linalg.norm(np.diff(told[:, :2, 3], axis=0), axis=1)
    unmoved = np.diff(revisions) == 0
    assert steps_m[unmoved].max() < 2 * STEP_M


def test_the_same_drive_gives_the_same_poses_to_the_bit(two_laps):
    path, _, _, revised = two_laps
    module, _ = run(furnished(np.random.default_rng(1)), path)
    np.testing.assert_array_equal(module.get_trajectory().T_world_base, revised.T_world_base)


def test_places_that_look_alike_close_no_wrong_loop():
    path = laps(2)
    module, _ = run(alike(), path)
    off_m = loop_errors_m(path, module.get_map().pose_graph)
    assert (off_m < 0.3).all()


def test_wide_search_finds_the_pose_and_says_where_it_cannot():
    reader = ScanSurfaceReader(
        T_base_laser=np.eye(4), range_max_m=20.0, noise_m=0.02, noise_per_m=0.0
    )
    walls = furnished(np.random.default_rng(2))
    seen = [
        reader.read(scan_at(walls, se3.from_xy_yaw(x, 0.0, 0.0), stamp_ns=0)).moved(
            np.array([x, 0.0, 0.0])
        )
        for x in (6.0, 7.0, 8.0)
    ]
    search = LoopSearch(LikelihoodField(seen[1], 0.05))
    truth = np.array([7.3, 0.2, 0.4])
    scan = reader.read(scan_at(walls, se3.from_xy_yaw(*truth), stamp_ns=0, **VIEW))
    around = truth + np.array([1.7, -1.2, 0.3])
    found = search.find(scan.points, around, window_m=2.5, window_rad=0.5, score_min=0.5)
    assert np.abs(found.T_submap_base - truth)[:2].max() < 0.15
    assert abs(found.T_submap_base[2] - truth[2]) < 0.05
    away = around + np.array([30.0, 0.0, 0.0])
    assert search.find(scan.points, away, window_m=2.5, window_rad=0.5, score_min=0.5) is None


def test_wide_search_in_a_corridor_is_ambiguous():
    reader = ScanSurfaceReader(
        T_base_laser=np.eye(4), range_max_m=20.0, noise_m=0.02, noise_per_m=0.0
    )
    walls = np.array([[[-200, -1], [200, -1]], [[-200, 1], [200, 1]]], float)
    scan = reader.read(scan_at(walls, np.eye(4), stamp_ns=0, beams=1440))
    search = LoopSearch(LikelihoodField(scan, 0.05))
    found = search.find(scan.points, np.zeros(3), window_m=3.0, window_rad=0.3, score_min=0.5)
    assert not found.is_unique


def test_graph_closes_a_ring_and_a_wrong_loop_does_little_harm():
    true = np.column_stack([np.cumsum(np.ones(20)), np.zeros(20), np.zeros(20)])
    spoilt = betweens(true[:-1], true[1:]) + np.array([0.0, 0.0, 0.02])
    poses = [true[0]]
    for motion in spoilt:
        poses.append(compose(poses[-1], motion))
    covariance = np.diag([0.01, 0.01, 0.02]) ** 2

    def edge(first, second, motion, is_loop=True):
        return ScanEdge(
            first=first,
            second=second,
            T_first_second=motion,
            covariance=covariance,
            is_loop=is_loop,
        )

    edges = [edge(i, i + 1, motion, is_loop=False) for i, motion in enumerate(spoilt)]
    edges += [edge(0, i, between(true[0], true[i])) for i in (12, 16, 18, 19)]
    found = optimise(edges, np.array(poses))
    assert np.abs(found - true).max() < 0.05
    graph = ScanPoseGraph()
    for one in edges:
        graph.add(one)
    np.testing.assert_allclose(graph.smooth(np.array(poses)), found, atol=0.02)
    wrong = [*edges, edge(2, 17, np.array([3.0, 1.0, 0.5]))]
    assert np.abs(optimise(wrong, np.array(poses)) - true).max() < 0.3


def test_pose_graph_of_the_map_holds_every_keyframe_and_edge():
    path = loop_path(120)
    module = LaserSlam(**settings())
    module.activate(Rig(sensors=frozenset({Sensor.SCAN}), laser=Laser()))
    for observation in drive(room(), path, rng=np.random.default_rng(1)):
        module.track(observation)
    graph = module.get_map().pose_graph
    assert (np.diff(graph.stamps_ns) > 0).all()
    chain = graph.edges[~graph.is_loop]
    following = np.arange(len(chain))
    np.testing.assert_array_equal(chain, np.column_stack([following, following + 1]))
    T_to = graph.T_world_base[chain[:, 0]] @ graph.T_from_to[~graph.is_loop]
    np.testing.assert_allclose(T_to, graph.T_world_base[chain[:, 1]], atol=0.05)
    assert (np.linalg.eigvalsh(graph.information) > 0).all()


def test_loops_that_are_left_to_the_atlas_make_no_graph():
    module = LaserSlam(**(settings() | {"close_loops": False}))
    module.activate(Rig(sensors=frozenset({Sensor.SCAN}), laser=Laser()))
    for observation in drive(room(), loop_path(20), rng=np.random.default_rng(1)):
        module.track(observation)
    layers = module.get_map()
    assert layers.pose_graph is None and layers.grid is not None


def test_scan_that_comes_twice_leaves_the_revised_poses_finite():
    path = loop_path(60)
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(4))
    stale = [replace(one, scan=observations[i - i % 3].scan) for i, one in enumerate(observations)]
    module = LaserSlam(**{**settings(), "keyframe_distance_m": 0.01})
    module.activate(Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()))
    for observation in stale:
        module.track(observation)
    assert np.isfinite(module.get_trajectory().T_world_base).all()


def test_composing_undoes_what_between_does():
    rng = np.random.default_rng(0)
    one, other = rng.uniform(-3, 3, (2, 50, 3))
    np.testing.assert_allclose(composed(one, betweens(one, other)), other, atol=1e-12)
