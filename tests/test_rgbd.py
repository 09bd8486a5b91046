"""The rgbd module as a whole: in a rendered room, and on a real recording."""

import itertools
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sceneslam.modules.slam.rgbd.module import RgbdSlam
from sceneslam.scans.occupancy_grid import drawn
from sceneslam.testing.room import RIG, room_observation
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.trajectory import Trajectory

CONFIG = Path(__file__).parents[1] / "conf" / "slam" / "rgbd.yaml"
FREIBURG1 = Camera(
    size_wh=(640, 480),
    fx=517.3,
    fy=516.5,
    cx=318.6,
    cy=255.3,
    distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
)
RGBD = frozenset({Sensor.IMAGE, Sensor.DEPTH})


def make(rig=RIG, **changes):
    settings = yaml.safe_load(CONFIG.read_text())
    del settings["_target_"]
    module = RgbdSlam(**settings | {"seed": 0, "is_repeatable": True} | changes)
    module.activate(rig)
    return module


def camera_only(index):
    observation = room_observation(index)
    return replace(observation, scan=None, points_lidar=None, T_odom_base=None, gyro_base=None)


def drive(module, observations):
    answers = [module.track(observation) for observation in observations]
    assert all(np.isfinite(answer.T_local_base).all() for answer in answers)
    return answers


def true_pose(index):
    start, now = room_observation(0), room_observation(index)
    return se3.inverse(start.T_odom_base) @ now.T_odom_base


def test_rendered_room_is_followed_within_its_own_sigmas():
    answers = drive(make(), [camera_only(index) for index in range(45)])
    for index, answer in enumerate(answers):
        T_error = se3.inverse(true_pose(index)) @ answer.T_local_base
        assert answer.status is TrackingStatus.TRACKING
        assert np.linalg.norm(T_error[:3, 3]) < 0.015
        assert se3.rotation_angle_rad(T_error) < 0.005
        assert (se3.log(T_error) ** 2 <= 9.0 * np.diag(answer.covariance)).all()


BAD_IMAGES = {
    "black": lambda image, rng: np.zeros_like(image),
    "white": lambda image, rng: np.full_like(image, 255),
    "noise": lambda image, rng: rng.integers(0, 256, image.shape, dtype=np.uint8),
    "dark_noise": lambda image, rng: np.clip(rng.normal(10, 4, image.shape), 0, 255).astype("u1"),
    "blurred": lambda image, rng: cv2.GaussianBlur(image, (0, 0), 25),
}


@pytest.mark.parametrize("kind", BAD_IMAGES)
def test_blind_image_is_lost_within_three_frames_and_found_again(kind):
    rng = np.random.default_rng(0)
    observations = [camera_only(index) for index in range(24)]
    for index in range(8, 16):
        image_bgr = BAD_IMAGES[kind](observations[index].image_bgr, rng)
        observations[index] = replace(observations[index], image_bgr=image_bgr)
    answers = drive(make(), observations)
    assert all(answer.status is TrackingStatus.LOST for answer in answers[10:16])
    assert (answers[15].T_local_base == answers[10].T_local_base).all()
    assert all(answer.status is TrackingStatus.TRACKING for answer in answers[16:])
    assert np.linalg.norm(answers[-1].T_local_base - true_pose(23)) < 0.03


def test_lost_pose_is_the_last_one_that_was_held_even_with_odometry():
    module = make()
    held = drive(module, [room_observation(index) for index in range(4)])[-1]
    dark = replace(room_observation(5), image_bgr=np.zeros((240, 320, 3), np.uint8))
    lost = module.track(dark)
    assert lost.status is TrackingStatus.LOST
    assert (lost.T_local_base == held.T_local_base).all()
    assert lost.covariance is None


@pytest.mark.parametrize("depth_m", [None, 0.0, np.nan, np.inf])
def test_missing_depth_is_bridged_by_the_map(depth_m):
    observations = [camera_only(index) for index in range(20)]
    for index in range(6, 14):
        blind = None if depth_m is None else np.full((240, 320), depth_m, np.float32)
        observations[index] = replace(observations[index], depth_m=blind)
    answers = drive(make(), observations)
    assert all(answer.status is not TrackingStatus.LOST for answer in answers)
    for index, answer in enumerate(answers):
        assert np.linalg.norm(answer.T_local_base - true_pose(index)) < 0.06
    doubt = [np.trace(answers[index].covariance) for index in (5, 6, 19)]
    assert doubt[1] > 2 * max(doubt[0], doubt[2])


def test_missing_depth_is_no_surface_at_the_camera_where_its_range_begins_at_0():
    near = replace(RIG, camera=replace(RIG.camera, depth_range_m=(0.0, 8.0)))
    holes = np.random.default_rng(0).random(camera_only(0).depth_m.shape) < 0.05

    def seen(index):
        observation = camera_only(index)
        depth_m = np.where(holes, np.float32(0.0), observation.depth_m)
        return replace(observation, depth_m=depth_m)

    usual, other = make(), make(near)
    for module in (usual, other):
        drive(module, map(seen, range(3)))
    poses = [module.get_trajectory().T_world_base for module in (other, usual)]
    np.testing.assert_array_equal(*poses)
    clouds = [module.get_map().points.points for module in (other, usual)]
    np.testing.assert_array_equal(*clouds)


def test_nothing_to_start_from_is_lost_at_the_identity():
    module = make()
    for index in range(3):
        answer = module.track(replace(camera_only(index), depth_m=None))
        assert answer.status is TrackingStatus.LOST
        assert (answer.T_local_base == np.eye(4)).all()
    started = module.track(camera_only(3))
    assert started.status is TrackingStatus.DEGRADED  # what came before was not measured
    assert module.track(camera_only(4)).status is TrackingStatus.TRACKING


def test_module_finds_its_way_back_to_a_place_it_left():
    module = make()
    drive(module, [camera_only(index) for index in range(0, 30, 2)])
    answer = module.track(camera_only(2))  # kidnapped
    assert answer.status is TrackingStatus.TRACKING
    assert np.linalg.norm(answer.T_local_base - true_pose(2)) < 0.03


def test_map_of_a_planar_robot_has_walls_in_cloud_and_scans():
    module = make()
    drive(module, [room_observation(index) for index in range(0, 30, 3)])
    layers = module.get_map()
    assert layers.points is not None and layers.grid is None
    room = se3.apply(room_observation(0).T_odom_base, layers.points.points.astype(float))
    beyond_wall_m = np.abs(room) - [3.0, 2.0, 1.2]
    assert np.abs(beyond_wall_m.max(axis=1)).max() < 0.05  # every point lies on a wall
    assert len(layers.points.points) == len(layers.points.colors_bgr) > 1000
    grid = drawn(layers.scans, layers.scans.T_world_laser)
    assert (grid.log_odds > 0.5).sum() > 20
    assert (grid.log_odds < -0.3).sum() > 200


@pytest.mark.parametrize(
    ("name", "value"), [("feature_count", 0), ("sigma_px", -1.0), ("keyframe_inlier_ratio", 1.5)]
)
def test_argument_out_of_range_is_named(name, value):
    with pytest.raises(ConfigError, match=name):
        make(**{name: value})


def test_arrays_of_the_wrong_size_and_a_rig_without_camera_are_refused():
    module = make()
    small = replace(camera_only(0), image_bgr=np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(InputError, match="image_bgr"):
        module.track(small)
    with pytest.raises(InputError, match=r"image_bgr: expected \(.*, 3\)"):
        module.track(replace(camera_only(0), image_bgr=camera_only(0).image_bgr[..., 0]))
    with pytest.raises(InputError, match="depth_m"):
        module.track(replace(camera_only(0), depth_m=np.ones((24, 32), np.float32)))
    with pytest.raises(InputError, match="camera"):
        module.activate(Rig(sensors=RGBD))


def read_freiburg1(folder, count):
    """Return the first observations of a TUM RGB-D folder; depth by nearest stamp."""
    rows = [
        [line.split() for line in (folder / name).read_text().splitlines() if line[0] != "#"]
        for name in ("rgb.txt", "depth.txt")
    ]
    depth_stamps_s = np.array([float(row[0]) for row in rows[1]])
    for stamp, name in itertools.islice(rows[0], count):
        nearest = int(np.argmin(np.abs(depth_stamps_s - float(stamp))))
        depth = cv2.imread(str(folder / rows[1][nearest][1]), cv2.IMREAD_UNCHANGED)
        yield Observation(
            stamp_ns=round(float(stamp) * 1e9),
            image_bgr=cv2.imread(str(folder / name)),
            depth_m=(depth / np.float32(5000)).astype(np.float32),
        )


def ate_rmse_m(answers, truth):
    nearest = [int(np.argmin(np.abs(truth.stamps_ns - answer.stamp_ns))) for answer in answers]
    estimated = np.stack([answer.T_local_base[:3, 3] for answer in answers])
    true = truth.positions_m[nearest]
    estimated, true = estimated - estimated.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(true.T @ estimated)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((true - estimated @ turn.T) ** 2).sum(axis=1).mean()))


def test_real_recording_is_tracked_the_same_to_the_bit_on_one_core(shared_data, monkeypatch):
    folder, rig = shared_data / "tum_fr1_rpy", Rig(sensors=RGBD, camera=FREIBURG1)
    observations = list(read_freiburg1(folder, 60))
    first = drive(make(rig), observations)
    monkeypatch.setenv("SCENESLAM_CORES", "1")
    monkeypatch.delattr(subprocess, "Popen")  # nothing works beside it
    second = drive(make(rig), observations)
    for one, other in zip(first, second, strict=True):
        assert one.T_local_base.tobytes() == other.T_local_base.tobytes()
        assert one.covariance.tobytes() == other.covariance.tobytes()
    assert all(answer.status is not TrackingStatus.LOST for answer in first)
    assert ate_rmse_m(first, Trajectory.read_tum(folder / "groundtruth.txt")) < 0.05


def test_frozen_image_over_moving_depth_is_not_trusted(shared_data):
    module = make(Rig(sensors=RGBD, camera=FREIBURG1))
    observations = list(read_freiburg1(shared_data / "tum_fr1_rpy", 40))
    drive(module, observations[:20])
    frozen = observations[19].image_bgr
    answers = drive(module, [replace(live, image_bgr=frozen) for live in observations[30:]])
    assert all(answer.status is not TrackingStatus.TRACKING for answer in answers)


def test_poses_that_odometry_leads_are_the_less_certain_the_farther_it_leads():
    answers = drive(make(degraded_inliers=1000), [room_observation(index) for index in range(15)])
    assert {answer.status for answer in answers[1:]} == {TrackingStatus.DEGRADED}
    sigmas_m = np.sqrt([np.trace(answer.covariance[:3, :3]) for answer in answers[1:]])
    assert (np.diff(sigmas_m) > 0).all()
    assert 0.001 < sigmas_m[-1] < 0.1  # after 14 cm


@pytest.mark.parametrize("has_odometry", [False, True])
def test_image_that_is_repeated_holds_no_pose(has_odometry):
    def seen(index):
        return room_observation(index) if has_odometry else camera_only(index)

    module = make()
    answers = drive(module, [seen(index) for index in range(10)])
    hanging = [
        replace(seen(index), image_bgr=seen(9).image_bgr, depth_m=seen(9).depth_m)
        for index in range(10, 25)
    ]
    repeated = drive(module, hanging)
    assert {answer.status for answer in repeated} == {TrackingStatus.DEGRADED}
    assert all(answer.covariance is None for answer in repeated)
    T_expected = true_pose(24) if has_odometry else answers[-1].T_local_base
    assert repeated[-1].T_local_base[:3, 3] == pytest.approx(T_expected[:3, 3], abs=0.01)
    assert drive(module, [seen(25)])[0].status is TrackingStatus.TRACKING
