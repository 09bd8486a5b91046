"""Loops of the laser module, by the atlas: round a ring of corridors with wheels that turn."""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from planar_poses import transforms
from test_laser_world import box, drive, loop_path, room, scan_at

from sceneslam.atlas.atlas import Atlas
from sceneslam.modules.slam.laser.field import LikelihoodField
from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.modules.slam.laser.surface import ScanSurfaceReader
from sceneslam.modules.slam.laser.wide_search import WideSearch
from sceneslam.types import se3
from sceneslam.types.maps import HybridMap
from sceneslam.types.planar import between, compose
from sceneslam.types.rig import Laser, Rig, Sensor
from sceneslam.types.trajectory import Trajectory

PERIOD_NS = 100_000_000
STEP_M = 0.15
WEAK_M = 0.5  # deviation of a loop along a direction that walls do not constrain, at least
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
    motions = np.array([between(*ends) for ends in pairwise(path)])
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


@dataclass(frozen=True, kw_only=True)
class Driven:
    """What module and atlas made of a drive."""

    events: list[dict[str, object]]
    tracked: Trajectory  # by the module, without loops
    online: Trajectory
    corrected: Trajectory
    map: HybridMap


def driven(rig, observations, **changes):
    """Return a drive with the laser module in an atlas."""
    module, atlas, events = LaserSlam(**{**settings(), **changes}), Atlas(voxel_m=0.05), []
    module.activate(rig)
    atlas.open(rig, lambda event, stamp_ns, **_: events.append({"event": event, "at": stamp_ns}))
    session = atlas.begin_session("laser", np.eye(4))
    for observation in observations:
        tracking = module.track(observation)
        atlas.add_local(tracking.stamp_ns, tracking.T_local_base)
        atlas.add(
            tracking.stamp_ns,
            tracking.T_local_base,
            "laser",
            tracking.covariance,
            tracking.map_covariance,
        )
        atlas.observe(observation, None)
    atlas.close_session(session, module.get_map(), module.get_trajectory())
    assert atlas.finish() == []
    return Driven(
        events=events,
        tracked=atlas.sessions[0].trajectory,
        online=atlas.online,
        corrected=atlas.trajectory,
        map=atlas.fuse_maps(),
    )


def run(walls, path):
    """Return a drive with wheels that turn too much."""
    observations = drive(
        walls,
        path,
        odometry=slipping(path, 0.03),
        rng=np.random.default_rng(3),
        period_ns=PERIOD_NS,
        **VIEW,
    )
    return driven(
        Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser()), observations
    )


def laps_apart_m(T_local_base):
    """Return how far the second lap's positions are from the first's, where they are the same."""
    positions = T_local_base[:, :2, 3]
    half = len(positions) // 2
    return np.linalg.norm(positions[half:] - positions[:half], axis=1)


def loop_errors_m(path, graph):
    """Return how far each loop is from the truth, in the directions that its walls constrain."""
    rows = graph.stamps_ns // PERIOD_NS
    first, second = rows[graph.edges[graph.is_loop]].T
    truth = transforms(map(between, path[first], path[second]))
    off = se3.log(se3.inverse(truth) @ graph.T_from_to[graph.is_loop])[:, :2]
    covariance = np.linalg.inv(graph.information[graph.is_loop])[:, :2, :2]
    variances, directions = np.linalg.eigh(covariance)
    along = np.einsum("nji,nj->ni", directions, off)
    return np.linalg.norm(np.where(variances < WEAK_M**2, along, 0.0), axis=1)


@pytest.fixture(scope="module")
def two_laps():
    return run(furnished(np.random.default_rng(1)), laps(2))


def test_second_lap_closes_loops_that_are_right(two_laps):
    off_m = loop_errors_m(laps(2), two_laps.map.pose_graph)
    assert len(off_m) > 8
    assert off_m.max() < 0.1


def test_corrected_laps_lie_on_each_other_where_odometry_had_drifted_apart(two_laps):
    assert len(two_laps.corrected) == len(laps(2))
    trajectories = two_laps.corrected, two_laps.online
    corrected_m, online_m = (laps_apart_m(one.T_world_base).mean() for one in trajectories)
    assert corrected_m < 0.02 < online_m


def test_loops_are_reported_while_the_robot_drives_and_correct_its_pose(two_laps):
    half_ns = PERIOD_NS * len(laps(2)) // 2
    loops_ns = [event["at"] for event in two_laps.events if event["event"] == "loop"]
    assert len(loops_ns) > 8 and min(loops_ns) >= 0.9 * half_ns
    last = slice(3 * len(laps(2)) // 4, None)
    tracked_m, online_m = (
        np.linalg.norm(one.T_world_base[last, :2, 3] - laps(2)[last, :2], axis=1).mean()
        for one in (two_laps.tracked, two_laps.online)
    )
    assert online_m < 0.5 * tracked_m, (online_m, tracked_m)


def test_the_same_drive_gives_the_same_poses_to_the_bit(two_laps):
    again = run(furnished(np.random.default_rng(1)), laps(2))
    for one, other in ((again.corrected, two_laps.corrected), (again.online, two_laps.online)):
        np.testing.assert_array_equal(one.T_world_base, other.T_world_base)


def test_places_that_look_alike_close_no_wrong_loop():
    path = laps(2)
    off_m = loop_errors_m(path, run(alike(), path).map.pose_graph)
    assert (off_m < 0.15).all()


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
    search = WideSearch(LikelihoodField(seen[1], 0.05))
    truth = np.array([7.3, 0.2, 0.4])
    scan = reader.read(scan_at(walls, se3.from_xy_yaw(*truth), stamp_ns=0, **VIEW))
    around = truth + np.array([1.7, -1.2, 0.3])
    found = search.find(scan.points, around, window_m=2.5, window_rad=0.5, alike_ratio=0.85)[0]
    assert np.abs(found.T_submap_base - truth)[:2].max() < 0.15
    assert abs(found.T_submap_base[2] - truth[2]) < 0.05
    away = around + np.array([30.0, 0.0, 0.0])
    assert search.find(scan.points, away, window_m=2.5, window_rad=0.5, alike_ratio=0.85) == []


def test_wide_search_in_a_corridor_is_ambiguous():
    reader = ScanSurfaceReader(
        T_base_laser=np.eye(4), range_max_m=20.0, noise_m=0.02, noise_per_m=0.0
    )
    walls = np.array([[[-200, -1], [200, -1]], [[-200, 1], [200, 1]]], float)
    scan = reader.read(scan_at(walls, np.eye(4), stamp_ns=0, beams=1440))
    search = WideSearch(LikelihoodField(scan, 0.05))
    found = search.find(scan.points, np.zeros(3), window_m=3.0, window_rad=0.3, alike_ratio=0.85)
    best, second = (one.T_submap_base for one in found[:2])
    assert found[1].score > 0.85 * found[0].score and abs(best[0] - second[0]) > 0.5


def test_scans_of_the_map_are_those_of_the_keyframes_at_their_poses():
    module, path = LaserSlam(**settings()), loop_path(120)
    module.activate(Rig(sensors=frozenset({Sensor.SCAN}), laser=Laser()))
    trackings = [module.track(one) for one in drive(room(), path, rng=np.random.default_rng(1))]
    scans = module.get_map().scans
    assert (np.diff(scans.stamps_ns) > 0).all() and len(scans.stamps_ns) > 5
    T_local_base = {tracking.stamp_ns: tracking.T_local_base for tracking in trackings}
    expected = [T_local_base[stamp_ns] for stamp_ns in scans.stamps_ns.tolist()]
    np.testing.assert_allclose(scans.T_world_laser, expected, atol=1e-9)


def test_scan_that_comes_twice_leaves_the_poses_finite():
    path = loop_path(60)
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(4))
    stale = [replace(one, scan=observations[i - i % 3].scan) for i, one in enumerate(observations)]
    rig = Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())
    found = driven(rig, stale, keyframe_distance_m=0.01)
    assert np.isfinite(found.corrected.T_world_base).all()


def test_composing_undoes_what_between_does():
    rng = np.random.default_rng(0)
    for one, other in rng.uniform(-3, 3, (50, 2, 3)):
        np.testing.assert_allclose(compose(one, between(one, other)), other, atol=1e-12)
