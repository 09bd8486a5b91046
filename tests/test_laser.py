"""The laser module in worlds of straight walls, whose motion is known."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_laser_world import box, corridor, drive, loop_path, room, scan_at

from sceneslam.interfaces import SlamModule
from sceneslam.modules.slam.laser.module import LaserSlam
from sceneslam.scans.occupancy_grid import drawn, walls
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Camera, Laser, Lidar, Rig, Sensor

SETTINGS = yaml.safe_load(
    (Path(__file__).resolve().parent.parent / "conf/slam/laser.yaml").read_text()
)
SETTINGS.pop("_target_")
LASER_RIG = Rig(sensors=frozenset({Sensor.SCAN, Sensor.ODOMETRY}), laser=Laser())


def active(rig=LASER_RIG, **settings):
    module = LaserSlam(**{**SETTINGS, **settings})
    module.activate(rig)
    return module


def errors(path, trackings):
    """Return position [m] and yaw [rad] errors (N, 2) against a path of (x, y, yaw)."""
    T_world_local = se3.from_xy_yaw(*path[0])
    off = [
        se3.inverse(T_world_local @ tracking.T_local_base) @ se3.from_xy_yaw(*pose)
        for pose, tracking in zip(path, trackings, strict=True)
    ]
    return np.array([[np.hypot(T[0, 3], T[1, 3]), abs(se3.yaw_rad(T))] for T in off])


def test_module_fulfils_the_interface():
    assert isinstance(active(), SlamModule)


def test_motion_in_a_room_is_found_without_odometry():
    path = loop_path(160)
    module = active()
    trackings = [module.track(o) for o in drive(room(), path, rng=np.random.default_rng(1))]
    assert {tracking.status for tracking in trackings} == {TrackingStatus.TRACKING}
    error = errors(path, trackings)
    assert error[:, 0].max() < 0.012
    assert error[:, 1].max() < 0.004


def test_poses_and_odometry_of_a_narrow_view_agree_on_the_motion():
    path = loop_path(200)
    slipping = path * [1.05, 1.05, 1.0]
    module = active()
    view = {"fov_rad": np.radians(57), "beams": 180, "range_max_m": 4.5}
    observations = drive(room(), path, odometry=slipping, rng=np.random.default_rng(2), **view)
    trackings = [module.track(observation) for observation in observations]
    assert TrackingStatus.LOST not in {tracking.status for tracking in trackings}
    assert errors(path, trackings)[:, 0].max() < 0.05


def test_corridor_takes_the_way_along_it_from_odometry_and_says_so():
    steps = np.arange(60)
    path = np.column_stack([0.06 * steps, 0.1 * np.sin(0.1 * steps), 0.05 * np.sin(0.2 * steps)])
    module = active()
    observations = drive(corridor(), path, odometry=path, rng=np.random.default_rng(3))
    trackings = [module.track(observation) for observation in observations]
    assert {t.status for t in trackings[2:]} == {TrackingStatus.DEGRADED}
    error = errors(path, trackings)
    assert error[:, 0].max() < 0.03
    assert error[:, 1].max() < 0.005
    variance = np.diag(trackings[-1].covariance)
    assert variance[0] > 4 * variance[1]


@pytest.mark.parametrize(("ahead_m", "half_m"), [(15.0, 0.7), (20.0, 0.95)])
def test_few_beams_on_a_far_wall_tell_the_motion_along_a_corridor(ahead_m, half_m):
    """Of 181 beams five see the wall ahead, and nothing else tells a motion."""
    end = np.array([[[ahead_m, -half_m], [ahead_m, half_m]]])
    module = active(replace(LASER_RIG, sensors=frozenset({Sensor.SCAN})))
    path = np.zeros((40, 3))
    path[:, 0] = 0.1 * np.maximum(np.arange(40) - 5, 0)
    seen = {"beams": 181, "fov_rad": np.radians(181.0), "range_max_m": 25.0}
    rng = np.random.default_rng(0)
    for observation in drive(np.concatenate([corridor(), end]), path, rng=rng, **seen):
        tracking = module.track(observation)
    assert tracking.T_local_base[0, 3] == pytest.approx(path[-1, 0], abs=0.1)


def test_motion_between_the_first_two_scans_is_found_without_wheels():
    """A car drives at 12 m/s already, beyond the window around what it is expected to do."""
    path = np.zeros((5, 3))
    path[:, 0] = 1.2 * np.arange(5)
    module = active(replace(LASER_RIG, sensors=frozenset({Sensor.SCAN})))
    hall = np.concatenate([box(-6, -8, 18, 8), box(3, 2, 4, 3), box(8, -4, 10, -3)])
    rng = np.random.default_rng(0)
    for observation in drive(hall, path, rng=rng, range_max_m=25.0):
        tracking = module.track(observation)
    assert tracking.T_local_base[0, 3] == pytest.approx(path[-1, 0], abs=0.05)


def test_corridor_corrects_the_drift_across_it():
    steps = np.arange(80)
    path = np.column_stack([0.06 * steps, 0 * steps, 0 * steps])
    odometry = np.column_stack([0.06 * steps, 0.01 * steps, 0.003 * steps])
    module = active()
    observations = drive(corridor(), path, odometry=odometry, rng=np.random.default_rng(4))
    last = [module.track(observation) for observation in observations][-1].T_local_base
    assert abs(last[1, 3]) < 0.05
    assert abs(se3.yaw_rad(last)) < 0.01
    assert abs(last[0, 3] - 0.06 * 79) < 0.1


def test_sweep_older_than_its_observation_is_matched_where_it_was_made():
    path = loop_path(160)
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(5))
    late = [observations[0]]
    for before, now in pairwise(observations):
        half = Observation(
            stamp_ns=now.stamp_ns - 40_000_000,
            T_odom_base=se3.interpolate(before.T_odom_base, now.T_odom_base, 0.6),
        )
        late += [half, replace(now, stamp_ns=now.stamp_ns + 20_000_000, T_odom_base=None)]
    ahead = path[1:] + 0.2 * np.diff(path, axis=0)
    for index, pose in enumerate(ahead):
        late[2 * index + 2] = replace(late[2 * index + 2], T_odom_base=se3.from_xy_yaw(*pose))
    module = active()
    trackings = [module.track(observation) for observation in late]
    assert errors(np.vstack([path[:1], ahead]), trackings[::2])[:, 0].max() < 0.012


def test_sweep_that_comes_after_newer_observations_is_matched_where_it_was_made():
    """A camera sets the pace, at 30 Hz; a scan, of every third image, is 0.12 s old."""
    fine = loop_path(480)
    observations = drive(room(), fine, odometry=fine, rng=np.random.default_rng(5))
    given = []
    for index, now in enumerate(observations):
        stamp_ns = index * 33_000_000
        scan = observations[index - 4].scan if index % 3 == 0 and index >= 4 else None
        scan = scan and replace(scan, stamp_ns=stamp_ns - 4 * 33_000_000)
        given.append(replace(now, stamp_ns=stamp_ns, scan=scan))
    module = active()
    off_m = errors(fine, [module.track(observation) for observation in given])[:, 0]
    assert off_m.max() < 0.012


@pytest.mark.parametrize("has_wheels", [True, False])
@pytest.mark.parametrize("late", [1, -1])
def test_scan_beside_its_observation_is_matched_where_it_was_made(late, has_wheels):
    """A message has the stamp of its first beam; the middle of its sweep is 33 ms later."""
    path = loop_path(480)
    odometry = path if has_wheels else None
    observations = drive(room(), path, odometry=odometry, rng=np.random.default_rng(5))
    given = []
    for index in range(3, 477, 3):  # it drives when the map begins
        stamp_ns = index * 33_000_000
        scan = observations[index + late].scan
        scan = replace(scan, stamp_ns=stamp_ns + late * 33_000_000)
        given.append(replace(observations[index], stamp_ns=stamp_ns, scan=scan))
    rig = LASER_RIG if has_wheels else replace(LASER_RIG, sensors=frozenset({Sensor.SCAN}))
    module = active(rig)
    off = errors(path[3:477:3], [module.track(observation) for observation in given])
    assert off[:, 0].max() < 0.008
    assert off[:, 1].mean() < 0.003  # 0.02, if the first scan is as of its observation


def test_slow_sweep_beside_a_fast_camera_is_matched_where_it_was_made():
    """It turns at 1 rad/s; a sweep takes 180 ms, and odometry and images come every 17 ms."""
    module, off_rad = active(), []
    for index in range(120):
        stamp_ns = index * 16_666_667
        yaw, ahead = (max(1e-9 * at_ns - 0.5, 0.0) for at_ns in (stamp_ns, stamp_ns + 90_000_000))
        scan = None
        if index % 11 == 0:
            T_world_then = se3.from_xy_yaw(0.5, 0.0, ahead)
            scan = scan_at(room(), T_world_then, stamp_ns=stamp_ns + 90_000_000)
        T_odom_base = se3.from_xy_yaw(0.0, 0.0, yaw)
        found = module.track(Observation(stamp_ns=stamp_ns, scan=scan, T_odom_base=T_odom_base))
        off_rad.append(se3.yaw_rad(found.T_local_base) - yaw)
    assert np.abs(off_rad[60:]).max() < 0.002  # 0.06, if it is bound by two periods of the camera


@pytest.mark.parametrize("late_s", [0.0, -0.08])
def test_the_motion_within_a_lidars_sweep_is_undone(late_s):
    """It turns at 1 rad/s, and a sweep takes 0.1 s; or the clouds are older than the images."""
    lidar = Lidar(range_m=(0.1, 30.0), T_base_lidar=se3.from_xy_yaw(0.2, 0.0, 0.5))
    module = active(Rig(sensors=frozenset({Sensor.POINTS}), lidar=lidar))
    beams = np.arange(720) * 2 * np.pi / 720
    times_s = np.linspace(0.0, 0.1, 720, endpoint=False) + late_s
    off_rad = []
    for index in range(40):
        begun_s = 0.1 * index
        yaws = np.maximum(begun_s + times_s - 1.0, 0.0)  # it stands for a second
        points = np.zeros((720, 3), np.float32)
        for row, (beam, yaw) in enumerate(zip(beams, yaws, strict=True)):
            at = se3.from_xy_yaw(0.0, 0.0, yaw) @ lidar.T_base_lidar
            ahead = at[:2, :2] @ [np.cos(beam), np.sin(beam)]
            walls = (np.sign(ahead) * [4.0, 3.0] - at[:2, 3]) / ahead  # of a room
            points[row, :2] = walls.min() * np.array([np.cos(beam), np.sin(beam)])
        found = module.track(
            Observation(stamp_ns=index * 10**8, points_lidar=points, point_times_s=times_s)
        )
        off_rad.append(se3.yaw_rad(found.T_local_base) - max(begun_s - 1.0, 0.0))
    off_rad = np.abs((np.array(off_rad) + np.pi) % (2 * np.pi) - np.pi)
    assert off_rad[14:].max() < 0.01


def test_a_sweep_is_undone_by_the_velocities_that_are_known():
    """That of the cloud before counts as much; at first, and where it is lost, one is unknown."""
    module = active(Rig(sensors=frozenset({Sensor.POINTS}), lidar=Lidar()))
    inertia, points = module._front_end.motion.inertia, np.ones((1, 3), np.float32)
    cloud = Observation(stamp_ns=0, points_lidar=points, point_times_s=np.array([0.1]))
    shifts_m = []
    for speed_m_s in (None, 2.0, 1.0, None, None):
        inertia.reset()
        if speed_m_s is not None:
            inertia.velocity, inertia.is_known = np.array([speed_m_s, 0, 0, 0, 0, 0]), True
        shifts_m.append(float(module._points_lidar(cloud)[0, 0] - 1.0))
    assert shifts_m == pytest.approx([0.0, 0.2, 0.15, 0.1, 0.0], abs=1e-6)


def test_observations_between_scans_are_predicted():
    path = loop_path(300)
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(6))
    sparse = [o if i % 3 == 0 else replace(o, scan=None) for i, o in enumerate(observations)]
    module = active()
    trackings = [module.track(observation) for observation in sparse]
    assert {tracking.status for tracking in trackings} == {TrackingStatus.TRACKING}
    assert errors(path, trackings)[:, 0].max() < 0.02


def test_no_return_and_no_odometry_is_lost_and_found_again():
    path = loop_path(160)
    observations = drive(room(), path, rng=np.random.default_rng(7))
    blind = np.full(360, np.nan, np.float32)
    for index in range(60, 72):
        scan = replace(observations[index].scan, ranges_m=blind)
        observations[index] = replace(observations[index], scan=scan)
    module = active()
    trackings = [module.track(observation) for observation in observations]
    assert trackings[71].status is TrackingStatus.LOST
    assert trackings[71].covariance is None
    np.testing.assert_array_equal(trackings[71].T_local_base, trackings[70].T_local_base)
    assert trackings[-1].status is TrackingStatus.TRACKING
    assert errors(path, trackings)[-1, 0] < 0.02


def test_no_return_with_odometry_is_degraded_and_goes_on():
    path = loop_path(160)
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(8))
    observations[60:80] = [replace(o, scan=None) for o in observations[60:80]]
    module = active()
    trackings = [module.track(observation) for observation in observations]
    assert trackings[79].status is TrackingStatus.DEGRADED
    assert np.trace(trackings[79].covariance) > np.trace(trackings[59].covariance)
    assert errors(path, trackings)[:, 0].max() < 0.03


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0, 1e9])
def test_broken_ranges_never_give_a_broken_pose(value):
    observations = drive(room(), loop_path(160)[:20], rng=np.random.default_rng(9))
    broken = replace(observations[0].scan, ranges_m=np.full(360, value, np.float32))
    module = active()
    for index, observation in enumerate(observations):
        scan = broken if index % 4 != 1 else observation.scan
        tracking = module.track(replace(observation, scan=scan))
        assert np.isfinite(tracking.T_local_base).all()
    empty = replace(broken, ranges_m=np.zeros(0, np.float32))
    tracking = module.track(replace(observations[-1], stamp_ns=10**10, scan=empty))
    assert np.isfinite(tracking.T_local_base).all()


def test_first_observation_is_the_origin_and_activation_starts_anew():
    path = loop_path(160)[30:]
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(10))
    module = active()
    first = [module.track(observation) for observation in observations]
    np.testing.assert_array_equal(first[0].T_local_base, np.eye(4))
    module.shutdown()
    module.shutdown()
    assert len(module.get_map().scans.stamps_ns) > 0
    module.activate(LASER_RIG)
    assert len(module.get_map().scans.stamps_ns) == 0
    again = [module.track(observation) for observation in observations]
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.T_local_base, two.T_local_base)
        assert one.status is two.status


def test_map_shows_the_walls_where_they_are():
    path = loop_path(160)
    module = active()
    for observation in drive(room(), path, rng=np.random.default_rng(11)):
        module.track(observation)
    scans = module.get_map().scans
    points = walls(scans, scans.T_world_laser)
    world = se3.apply(se3.from_xy_yaw(*path[0]), points.astype(float))
    outer = np.minimum.reduce(
        [np.abs(world[:, 0] + 2), np.abs(world[:, 0] - 4), np.abs(np.abs(world[:, 1]) - 2)]
    )
    assert 3000 < len(points) <= (scans.ranges_m > 0).sum()
    assert (outer < 0.05).mean() > 0.6


def test_mounted_laser_gives_the_motion_of_base():
    path = loop_path(160)
    T_base_laser = se3.from_xy_yaw(0.25, -0.1, 0.6)
    at_laser = [se3.from_xy_yaw(*pose) @ T_base_laser for pose in path]
    laser_path = [(T[0, 3], T[1, 3], se3.yaw_rad(T)) for T in at_laser]
    rig = Rig(sensors=frozenset({Sensor.SCAN}), laser=Laser(T_base_laser=T_base_laser))
    module = active(rig)
    observations = drive(room(), laser_path, rng=np.random.default_rng(12))
    assert errors(path, [module.track(o) for o in observations])[:, 0].max() < 0.015


def test_depth_is_the_laser_where_there_is_none():
    camera = Camera(size_wh=(64, 48), fx=52.5, fy=52.5, cx=31.5, cy=23.5)
    rig = Rig(sensors=frozenset({Sensor.DEPTH, Sensor.IMAGE}), camera=camera)
    module = active(rig, depth_stride_px=1, depth_beams=60)
    depth = np.full((48, 64), 2.0, np.float32)
    for index in range(5):
        tracking = module.track(Observation(stamp_ns=index * 10**8, depth_m=depth))
    assert tracking.status is TrackingStatus.DEGRADED  # one wall does not hold the way along it
    assert np.abs(tracking.T_local_base - np.eye(4)).max() < 0.01
    scans = module.get_map().scans
    assert (drawn(scans, scans.T_world_laser).log_odds > 0).sum() > 20


@pytest.mark.parametrize(
    ("name", "value"),
    [("resolution_m", 0.0), ("beams_min", 0), ("inlier_min_ratio", 1.5), ("predict_max_s", -1.0)],
)
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ConfigError, match=name):
        LaserSlam(**{**SETTINGS, name: value})


@pytest.mark.parametrize("jump_m", [20.0, 3000.0])
def test_odometry_that_was_reset_is_not_taken_for_motion(jump_m):
    path = np.array(loop_path(160))[:80]
    observations = drive(room(), path, odometry=path, rng=np.random.default_rng(1))
    reset = se3.from_xy_yaw(jump_m, -jump_m, 1.0)
    observations[40:] = [replace(o, T_odom_base=reset @ o.T_odom_base) for o in observations[40:]]
    module = active()
    trackings = [module.track(observation) for observation in observations]
    assert errors(path, trackings)[:, 0].max() < 0.03


def first_keyframe(**settings):
    """Return the keyframes of a module after one scan, and the surfaces of that scan."""
    module = active(**settings)
    module.track(drive(room(), np.zeros((1, 3)), rng=np.random.default_rng(1))[0])
    keyframes = module._front_end.keyframes
    return keyframes, module._front_end.reader.read(keyframes.frames[0].scan)


def test_map_to_match_with_ends_where_no_scan_can_reach():
    keyframes, surfaces = first_keyframe(range_max_m=25.0)
    (first,) = keyframes.frames
    for index in range(1, 12):
        T_local_base = np.array([24.0 * index, 0.0, 0.0])
        keyframes.add(replace(first, T_local_base=T_local_base), surfaces)
    assert len(keyframes.latest()) == 3 * len(surfaces)  # at 264, 240 and 216 m


def test_scans_are_matched_with_the_latest_two_submaps():
    keyframes, surfaces = first_keyframe(submap_keyframes=3)
    (first,) = keyframes.frames
    counts = []
    for _ in range(8):
        counts.append(len(keyframes.latest()) // len(surfaces))
        keyframes.add(first, surfaces)
    assert counts == [1, 2, 3, 4, 5, 6, 4, 5]


def test_robot_that_was_turned_by_hand_is_found_again():
    """Its wheels report nothing of 1.5 rad in 1 s."""
    path = loop_path(160)
    path[80:, 2] += 1.5
    told = loop_path(160)
    observations = drive(room(), path, odometry=told, rng=np.random.default_rng(1))
    late = [
        replace(each, stamp_ns=stamp_ns, scan=replace(each.scan, stamp_ns=stamp_ns))
        for each in observations
        for stamp_ns in [each.stamp_ns + 900_000_000 * (each.stamp_ns >= 8_000_000_000)]
    ]
    module = active()
    trackings = [module.track(observation) for observation in late[:81]]
    assert (
        module._front_end.motion.inertia.velocity == 0
    ).all()  # what wheels missed tells no velocity
    trackings += [module.track(observation) for observation in late[81:]]
    assert errors(path, trackings)[80:].max() < 0.02
