"""The KISS-ICP adapter on clouds of a cluttered hall, whose motion is known."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import yaml
from ros_recordings import make_source

from sceneslam.interfaces import SlamModule
from sceneslam.modules.slam.kiss_icp import KissIcp
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Lidar, Rig, Sensor
from sceneslam.types.trajectory import Trajectory

SETTINGS = yaml.safe_load(
    (Path(__file__).resolve().parent.parent / "conf/slam/kiss_icp.yaml").read_text()
)
SETTINGS.pop("_target_")
RANGE_M = (0.5, 30.0)
RIG = Rig(sensors=frozenset({Sensor.POINTS}), lidar=Lidar(range_m=RANGE_M))


def active(rig=RIG, **settings):
    module = KissIcp(**{**SETTINGS, **settings})
    module.activate(rig)
    return module


def hall():
    """Return the points (N, 3) of a hall's floor and of many boxes that stand on it."""
    rng = np.random.default_rng(0)
    centres = rng.uniform([-15, -15], [15, 15], (60, 2))
    corner = rng.uniform(-0.6, 0.6, (60, 250, 3)) * rng.uniform(0.3, 1.5, (60, 1, 3))
    face = rng.integers(0, 3, (60, 250))[..., None] == np.arange(3)
    boxes = np.where(face, 0.6 * np.sign(corner), corner) + np.array([0, 0, 0.6])
    boxes[..., :2] += centres[:, None]
    floor = np.column_stack([rng.uniform(-15, 15, (4000, 2)), np.zeros(4000)])
    return np.vstack([boxes.reshape(-1, 3), floor])


def seen(points, T_world_lidar, *, seed):
    """Return the points in the lidar's frame, with 1 cm of noise."""
    noise = np.random.default_rng(seed).normal(0, 0.01, points.shape)
    return (se3.apply(se3.inverse(T_world_lidar), points) + noise).astype(np.float32)


def drive(count, T_base_lidar=None, *, speed_m=0.15, odometry=False):
    """Return observations and their T_world_base."""
    points = hall()
    T_base_lidar = se3.identity() if T_base_lidar is None else T_base_lidar
    poses = [se3.from_xy_yaw(speed_m * i, 0.02 * i, 0.02 * i) for i in range(count)]
    observations = [
        Observation(
            stamp_ns=index * 100_000_000,
            points_lidar=seen(points, T @ T_base_lidar, seed=index),
            T_odom_base=T if odometry else None,
        )
        for index, T in enumerate(poses)
    ]
    return observations, poses


def worst_error_m(trackings, poses):
    return max(
        np.linalg.norm((se3.inverse(poses[0]) @ T)[:3, 3] - tracking.T_local_base[:3, 3])
        for tracking, T in zip(trackings, poses, strict=True)
    )


def test_module_fulfils_the_interface():
    assert isinstance(active(), SlamModule)


def test_odometry_that_is_rounded_does_not_stop_the_process():
    observations, poses = drive(12, odometry=True)
    rounded = np.diag([1 + 1e-9, 1, 1, 1])  # its rotations do not multiply to rotations
    module = active()
    told = [replace(o, T_odom_base=o.T_odom_base @ rounded) for o in observations]
    assert worst_error_m([module.track(o) for o in told], poses) < 0.06


@pytest.mark.parametrize("odometry", [False, True])
def test_motion_in_a_hall_is_found(odometry):
    observations, poses = drive(25, odometry=odometry)
    module = active()
    trackings = [module.track(observation) for observation in observations]
    assert {tracking.status for tracking in trackings} == {TrackingStatus.TRACKING}
    np.testing.assert_allclose(trackings[0].T_local_base, np.eye(4), atol=1e-9)
    assert worst_error_m(trackings, poses) < 0.06
    assert trackings[-1].quality_ratio > 0.7
    assert 1000 < len(module.get_map().points.points) < 100_000


def test_mounted_lidar_gives_the_motion_of_base():
    T_base_lidar = se3.from_xy_yaw(0.5, 0.2, 0.7)
    T_base_lidar[2, 3] = 1.2
    rig = Rig(sensors=RIG.sensors, lidar=Lidar(range_m=RANGE_M, T_base_lidar=T_base_lidar))
    observations, poses = drive(20, T_base_lidar)
    module = active(rig)
    assert worst_error_m([module.track(o) for o in observations], poses) < 0.06


def test_two_runs_are_identical_to_the_bit():
    observations, _ = drive(12)
    runs = []
    for _ in range(2):
        module = active()
        runs.append([module.track(observation).T_local_base for observation in observations])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_environment_does_not_change_the_settings(monkeypatch):
    observations, _ = drive(8)
    module = active()
    plain = [module.track(observation).T_local_base for observation in observations]
    monkeypatch.setenv("kiss_icp_mapping", '{"voxel_size": 5.0, "max_points_per_voxel": 1}')
    monkeypatch.setenv("kiss_icp_registration", "not even JSON")
    monkeypatch.setenv("kiss_icp_adaptive_threshold", '{"fixed_threshold": 0.001}')
    module = active()
    again = [module.track(observation).T_local_base for observation in observations]
    np.testing.assert_array_equal(plain, again)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_broken_clouds_are_lost_and_tracking_comes_back(value):
    observations, poses = drive(12, speed_m=0.02)
    module = active()
    for index, observation in enumerate(observations):
        if index in (5, 6):
            observation = replace(observation, points_lidar=np.full((500, 3), value, np.float32))
        if index == 7:
            observation = replace(observation, points_lidar=np.zeros((0, 3), np.float32))
        tracking = module.track(observation)
        assert np.isfinite(tracking.T_local_base).all()
        assert (tracking.status is TrackingStatus.LOST) == (index in (5, 6, 7))
    expected = (se3.inverse(poses[0]) @ poses[-1])[:3, 3]
    assert np.linalg.norm(tracking.T_local_base[:3, 3] - expected) < 0.06


def test_jump_that_no_robot_makes_is_refused():
    observations, _ = drive(8)
    module = active(speed_max_m_s=3.0)
    for observation in observations:
        held = module.track(observation)
    away = replace(
        observations[-1],
        stamp_ns=observations[-1].stamp_ns + 100_000_000,
        points_lidar=observations[-1].points_lidar + np.float32([0.9, 0, 0]),
    )
    tracking = module.track(away)
    assert tracking.status is TrackingStatus.LOST
    np.testing.assert_array_equal(tracking.T_local_base, held.T_local_base)


def test_odometry_carries_on_without_clouds():
    observations, poses = drive(20, odometry=True)
    empty = np.zeros((0, 3), np.float32)
    module = active()
    blind = [
        replace(observation, points_lidar=empty) if index >= 10 else observation
        for index, observation in enumerate(observations)
    ]
    trackings = [module.track(observation) for observation in blind]
    assert trackings[-1].status is TrackingStatus.DEGRADED
    assert worst_error_m(trackings, poses) < 0.06
    assert np.trace(trackings[-1].covariance) > np.trace(trackings[9].covariance)


def test_observations_without_a_cloud_are_predicted_for_a_moment():
    observations, _ = drive(10)
    module = active()
    for observation in observations:
        last = module.track(observation)
    stamps = [observations[-1].stamp_ns + step * 100_000_000 for step in (1, 9)]
    soon, late = [module.track(Observation(stamp_ns=stamp)) for stamp in stamps]
    assert soon.status is TrackingStatus.TRACKING
    assert soon.T_local_base[0, 3] > last.T_local_base[0, 3] + 0.05
    assert late.status is TrackingStatus.LOST


def test_activation_starts_anew_and_shutdown_may_come_twice():
    observations, _ = drive(6)
    module = active()
    first = [module.track(observation).T_local_base for observation in observations]
    module.shutdown()
    module.shutdown()
    assert len(module.get_map().points.points) > 1000
    module.activate(RIG)
    assert len(module.get_map().points.points) == 0
    again = [module.track(observation).T_local_base for observation in observations]
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize(
    ("name", "value"), [("voxel_m", 0.0), ("depth_stride_px", -1), ("overlap_min_ratio", 2.0)]
)
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ConfigError, match=name):
        KissIcp(**{**SETTINGS, name: value})


@pytest.mark.parametrize("first", [0, 60])
def test_the_first_step_of_a_real_drive_is_found(shared_data, first):
    """Its velocity, 14 and 10 m/s, is not known before."""
    source = make_source("kitti", shared_data / "kitti_raw_2011_09_26_drive_0001")
    truth, module = source.ground_truth().trajectory.T_world_base, active(source.rig)
    found = [module.track(one) for one in islice(source, first, first + 2)][1]
    T_true = se3.inverse(truth[first]) @ truth[first + 1]
    assert np.linalg.norm(found.T_local_base[:3, 3] - T_true[:3, 3]) < 0.04


def test_start_of_a_real_drive_is_followed(shared_data):
    folder = shared_data / "kitti_raw_2011_09_26_drive_0001"
    truth = Trajectory.read_tum(folder / "groundtruth_tum.txt")
    module = active(Rig(sensors=RIG.sensors, lidar=Lidar()))
    positions = []
    for index in range(2, 16):
        cloud = np.fromfile(folder / "velodyne" / f"{index:06d}.bin", np.float32)
        observation = Observation(
            stamp_ns=int(truth.stamps_ns[index]),
            points_lidar=cloud.reshape(-1, 4)[:, :3],
            T_odom_base=truth.T_world_base[index] if index < 4 else None,
        )
        positions.append(module.track(observation).T_local_base[:3, 3])
    driven = np.linalg.norm(positions[-1])
    expected = np.linalg.norm(truth.positions_m[15] - truth.positions_m[2])
    assert driven == pytest.approx(expected, abs=0.4)


def bare(T_world_lidar, *, seed, ends):
    """Return a cloud of a corridor along x, 3 m wide, without ends or with walls at +-12 m."""
    rng = np.random.default_rng(seed)
    x, face = rng.uniform(-25, 25, 8000), rng.integers(0, 4, 8000)
    across = rng.uniform(-1.5, 1.5, 8000)
    y = np.choose(face, [-1.5, 1.5, across, across])
    z = np.choose(face, [across, across, -1.2, 1.3])
    walls = np.column_stack([x + T_world_lidar[0, 3], y, z])
    if ends:
        walls = walls[np.abs(walls[:, 0]) < 12]
        sides = rng.uniform(-1.2, 1.2, (2, 800, 2))
        for end, side in zip((-12.0, 12.0), sides, strict=True):
            walls = np.vstack([walls, np.column_stack([np.full(800, end), side])])
    return seen(walls, T_world_lidar, seed=seed)


def walk(module, *, ends, odometry, count=20):
    """Return what the module tells of 0.1 m per cloud along the corridor."""
    poses = [se3.from_xy_yaw(0.1 * index, 0.0, 0.0) for index in range(count)]
    return [
        module.track(
            Observation(
                stamp_ns=index * 100_000_000,
                points_lidar=bare(T, seed=index, ends=ends),
                T_odom_base=T if odometry else None,
            )
        )
        for index, T in enumerate(poses)
    ], poses


def test_bare_corridor_is_degraded_along_its_axis_and_odometry_fills_it():
    trackings, poses = walk(active(), ends=False, odometry=True)
    assert {tracking.status for tracking in trackings} == {TrackingStatus.DEGRADED}
    _, directions = np.linalg.eigh(trackings[-1].covariance[:3, :3])
    assert abs(directions[0, -1]) > 0.99
    assert worst_error_m(trackings, poses) < 0.05


def test_noise_does_not_move_the_pose_along_what_is_not_seen():
    trackings, _ = walk(active(), ends=False, odometry=False)
    assert {tracking.status for tracking in trackings} == {TrackingStatus.DEGRADED}
    assert abs(trackings[-1].T_local_base[0, 3]) < 0.1
    dragged, _ = walk(active(weak_ratio=0.0), ends=False, odometry=False)
    assert abs(dragged[-1].T_local_base[0, 3]) > 0.2  # neither at rest nor the 1.9 m walked
    deviations = [np.sqrt(tracking.covariance[0, 0]) for tracking in trackings]
    assert np.diff(deviations).min() > -0.01  # but for what single clouds seem to hold
    assert deviations[-1] > 2 * deviations[1]


def test_ends_of_the_corridor_hold_it():
    trackings, poses = walk(active(), ends=True, odometry=True)
    assert {tracking.status for tracking in trackings} == {TrackingStatus.TRACKING}
    assert worst_error_m(trackings, poses) < 0.06


def test_the_velocity_is_known_by_clouds_alone():
    """By it points are deskewed, and scans found that come after others were lost."""
    far = replace(RIG, lidar=Lidar(range_m=(0.5, 100.0)))
    module, (observations, poses) = active(far), drive(40, speed_m=0.5)
    for observation in observations:
        module.track(observation)
    right = se3.log(se3.inverse(poses[-2]) @ poses[-1])[:3] / 0.1  # 5 m/s
    assert np.linalg.norm(module._predictor.model.inertia.velocity[:3] - right) < 0.5


@pytest.mark.parametrize("lost", [4, 20])
def test_after_seconds_without_clouds_the_pose_is_right_or_lost(lost):
    module, (observations, poses) = active(), drive(60)
    for observation in observations[:20]:
        module.track(observation)
    first = 20 + lost
    answers = [module.track(observation) for observation in observations[first : first + 5]]
    if lost == 4:
        assert {answer.status for answer in answers} == {TrackingStatus.TRACKING}
        moved = [se3.inverse(poses[0]) @ pose for pose in poses[first : first + 5]]
        off_m = [
            answer.T_local_base[:3, 3] - T[:3, 3] for answer, T in zip(answers, moved, strict=True)
        ]
        assert np.linalg.norm(off_m, axis=1).max() < 0.05
    else:  # it may have turned by half a turn since then
        assert {answer.status for answer in answers} == {TrackingStatus.LOST}
        assert all(answer.can_begin for answer in answers)


def test_a_sensor_that_is_slow_or_was_covered_is_not_lost():
    (observations, poses), module = drive(12), active()
    slow = [replace(one, stamp_ns=6 * one.stamp_ns) for one in observations]
    answers = [module.track(one) for one in slow]  # every 0.6 s
    assert {answer.status for answer in answers} == {TrackingStatus.TRACKING}
    assert worst_error_m(answers, poses) < 0.05
    module, same = active(), observations[0]
    for index in range(150):
        points = same.points_lidar[:10] if 100 <= index < 140 else same.points_lidar
        answer = module.track(replace(same, stamp_ns=index * 100_000_000, points_lidar=points))
    assert answer.status is TrackingStatus.TRACKING
