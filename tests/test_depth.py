"""The depth module: what it finds in the dark, and what it says where nothing holds it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from depth_views import CAMERA, CORRIDOR, RIG, ROOM, WALL, cave, depth_image, handheld, observe

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.modules.slam.camera_certainty import CameraCertainty
from sceneslam.modules.slam.depth.keyframe_map import KeyframeMap
from sceneslam.modules.slam.depth.localizer import DepthLocalizer
from sceneslam.modules.slam.depth.module import DepthSlam
from sceneslam.modules.slam.depth.pose_graph import DepthPoseGraph
from sceneslam.modules.slam.model_error import squared
from sceneslam.modules.slam.surfaces.keyframe import SurfaceKeyframe
from sceneslam.modules.slam.surfaces.registration import (
    CameraPrior,
    SurfaceRegistration,
    register,
    samples_of,
)
from sceneslam.modules.slam.surfaces.surface import DepthSurfaceReader
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.trajectory import Trajectory

CONF = Path(__file__).resolve().parents[1] / "conf"
SETTINGS = yaml.safe_load((CONF / "slam/depth.yaml").read_text())
SETTINGS.pop("_target_")


def active(rig=RIG, **settings):
    module = DepthSlam(**{**SETTINGS, **settings})
    module.activate(rig)
    return module


def track(module, planes, poses, *, first=0, odometry=None):
    """Return what the module tells along the poses; `odometry` gives T_odom_base of a pose."""
    return [
        module.track(
            observe(planes, T, first + i, odometry=None if odometry is None else odometry(T))
        )
        for i, T in enumerate(poses)
    ]


def errors_m(trackings, poses):
    return [
        np.linalg.norm((se3.inverse(poses[0]) @ T)[:3, 3] - tracking.T_local_base[:3, 3])
        for tracking, T in zip(trackings, poses, strict=True)
    ]


def along_x(count, step_m):
    return [se3.from_xy_yaw(step_m * i, 0.0, 0.0) for i in range(count)]


def test_points_that_err_together_count_as_few():
    T = CAMERA.T_base_cam
    reader = DepthSurfaceReader(CAMERA)
    clean_m = depth_image(ROOM, np.eye(4), seed=0)
    bent_m = clean_m + 0.02 * (np.arange(clean_m.shape[1]) > clean_m.shape[1] / 2) * (clean_m > 0)
    found = []
    for image_m in (depth_image(ROOM, np.eye(4), seed=1), np.asarray(bent_m, np.float32)):
        known = SurfaceKeyframe(reader.read(clean_m), T)
        samples = samples_of(reader.read(image_m), reader.grid)
        prior = CameraPrior(T, np.eye(6))
        found.append(register(samples, prior, [known], reader.grid, weak_ratio=0.005))
    assert found[0].common_ratio < 20.0
    assert found[1].common_ratio > 10.0 * found[0].common_ratio
    kept = []
    for one in found:
        certainty = CameraCertainty(T)
        certainty.follow(
            common_ratio=one.common_ratio,
            misfit=one.misfit,
            T_keyframe_cam=one.T_keyframe_cam,
            away2_m2=4.0,
        )
        kept.append(certainty.covariance(np.eye(6)))
    np.testing.assert_allclose(kept[0], np.eye(6))
    assert kept[1][0, 0] > 1.5


def test_pulls_are_measured_where_rounding_leaves_an_information_below_zero():
    information = np.diag([1e6, 1e6, 1e6, 1e6, 1.0, -0.1])
    pulls = np.diag([1e3, 1e3, 1e3, 1e3, 0.0, 0.0])
    assert squared(pulls, information) == pytest.approx(4.0, rel=1e-6)


def test_hand_held_motion_is_found_without_any_light():
    poses = [handheld(index) for index in range(60)]
    module = active()
    trackings = track(module, ROOM, poses)
    assert {tracking.status for tracking in trackings} == {TrackingStatus.TRACKING}
    assert max(errors_m(trackings, poses)) < 0.01
    turned = se3.inverse(se3.inverse(poses[0]) @ poses[-1]) @ trackings[-1].T_local_base
    assert se3.rotation_angle_rad(turned) < 0.005
    assert trackings[-1].quality_ratio > 0.9


def test_covariance_promises_neither_too_much_nor_nothing():
    poses = [handheld(0.5 * index) for index in range(40)]
    trackings = track(active(), ROOM, poses)
    squares = []
    for tracking, T in list(zip(trackings, poses, strict=True))[1:]:
        off = se3.log(se3.inverse(se3.inverse(poses[0]) @ T) @ tracking.T_local_base)
        squares.append(off @ np.linalg.solve(tracking.covariance, off) / 6.0)
    assert np.mean(squares) < 1.0  # far below: neighbouring pixels here do not err alike
    assert np.sqrt(np.diag(trackings[-1].covariance)).max() < 0.005


def test_facing_one_wall_is_degraded_but_its_distance_is_held():
    poses = along_x(30, 0.01)
    trackings = track(active(), WALL, poses)
    assert {tracking.status for tracking in trackings[1:]} == {TrackingStatus.DEGRADED}
    off = [T[0, 3] - t.T_local_base[0, 3] for t, T in zip(trackings, poses, strict=True)]
    assert np.abs(off).max() < 0.005
    deviation = np.sqrt(np.diag(trackings[-1].covariance)[:3])
    assert min(deviation[1:]) > 5 * deviation[0]


def test_bare_corridor_is_degraded_along_its_axis_and_odometry_fills_it():
    poses = along_x(40, 0.02)
    trackings = track(active(), CORRIDOR, poses, odometry=lambda T: T)
    assert {tracking.status for tracking in trackings[1:]} == {TrackingStatus.DEGRADED}
    values, directions = np.linalg.eigh(trackings[-1].covariance[:3, :3])
    assert abs(directions[0, -1]) > 0.95
    assert values[-1] > 9 * values[-2]
    assert max(errors_m(trackings, poses)) < 0.01


def test_without_odometry_a_corridor_does_not_carry_the_pose_away():
    poses = [se3.identity()] * 40
    trackings = track(active(), CORRIDOR, poses)
    assert trackings[-1].status is TrackingStatus.DEGRADED
    assert max(errors_m(trackings, poses)) < 0.05


def test_unknown_view_is_lost_and_the_known_one_is_found_again():
    poses = [handheld(index) for index in range(20)]
    module = active()
    held = track(module, ROOM, poses)[-1]
    alien = [
        (-0.5, 0.7, 0.5, 0.6),
        (0.3, -0.9, 0.3, 0.5),
        (1, 0, 0.2, 0.55),
        (0.4, 0.1, -0.9, 0.45),
    ]
    lost = track(module, alien, [se3.identity()] * 5, first=20)
    assert {tracking.status for tracking in lost} == {TrackingStatus.LOST}
    np.testing.assert_array_equal(lost[-1].T_local_base, held.T_local_base)
    back = [handheld(5.0 + 0.2 * index) for index in range(10)]
    found = track(module, ROOM, back, first=25)
    assert {tracking.status for tracking in found} == {TrackingStatus.TRACKING}
    expected = (se3.inverse(poses[0]) @ back[-1])[:3, 3]
    assert np.linalg.norm(found[-1].T_local_base[:3, 3] - expected) < 0.01


@pytest.mark.parametrize("gap_images", [60, 120])
def test_after_a_gap_another_room_is_not_taken_for_the_known_one(gap_images):
    module = active()
    track(module, ROOM, [handheld(index) for index in range(30)])
    first = 30 + gap_images
    other = cave(14)
    lost = track(module, other, [handheld(first + i) for i in range(10)], first=first)
    assert {tracking.status for tracking in lost} == {TrackingStatus.LOST}


def test_somebody_who_walks_by_does_not_end_tracking_at_ten_images_a_second():
    module = active()
    statuses = set()
    for index in range(20):
        observation = observe(ROOM, se3.identity(), index, rate_hz=10.0)
        walker = observation.depth_m.copy()
        walker[:, 30 * index % 240 : 30 * index % 240 + 60] = 1.4
        statuses.add(module.track(replace(observation, depth_m=walker)).status)
    assert statuses == {TrackingStatus.TRACKING}


def test_after_a_gap_a_corner_like_another_is_not_taken_for_it():
    """A square room: after a turn by 90 degrees it looks the same."""
    square = [(1, 0, 0, 2.0), (-1, 0, 0, 2.0), (0, 1, 0, 2.0), (0, -1, 0, 2.0), (0, 0, 1, 0.7)]
    turns = [np.pi / 4 + min(index, 56) * np.pi / 112 for index in range(60)]
    module = active()
    before = track(module, square, [se3.from_xy_yaw(0.0, 0.0, turn) for turn in turns])
    assert before[-1].status is TrackingStatus.TRACKING
    after = track(module, square, [se3.from_xy_yaw(0.0, 0.0, 5 * np.pi / 4)] * 5, first=160)
    assert {tracking.status for tracking in after} == {TrackingStatus.LOST}


def test_after_a_gap_the_camera_is_found_where_it_is():
    before = [handheld(index) for index in range(60)]
    after = [handheld(10 + index) for index in range(10)]
    module = active()
    track(module, ROOM, before)
    trackings = track(module, ROOM, after, first=180)
    assert {tracking.status for tracking in trackings} == {TrackingStatus.TRACKING}
    for tracking, T in zip(trackings, after, strict=True):
        off = se3.inverse(se3.inverse(before[0]) @ T) @ tracking.T_local_base
        assert np.linalg.norm(off[:3, 3]) < 0.02


@pytest.mark.parametrize(("known_ratio", "is_found"), [(0.3, False), (0.7, True)])
def test_a_view_is_found_again_by_three_keyframes_if_they_show_its_larger_part(
    known_ratio, is_found
):
    reader = DepthSurfaceReader(CAMERA)
    known_m, image_m = (depth_image(ROOM, np.eye(4), seed=seed) for seed in (0, 1))
    known_m[:, round(known_ratio * CAMERA.size_wh[0]) :] = 0.0
    keyframes = KeyframeMap(reader.grid)
    for _ in range(3):
        keyframes.add(reader.read(known_m), CAMERA.T_base_cam)
    image = reader.read(image_m)
    localizer = DepthLocalizer(keyframes, matched_min_ratio=0.4, weak_ratio=0.005)
    vague = CameraPrior(CAMERA.T_base_cam, np.eye(6))
    found = localizer.locate(samples_of(image, reader.grid), image, vague, None, after_gap=True)
    assert (found is not None) is is_found


def test_blind_camera_is_lost_without_odometry_and_degraded_with_it():
    poses = along_x(20, 0.02)
    blind = np.zeros((CAMERA.size_wh[1], CAMERA.size_wh[0]), np.float32)
    for odometry, status in ((None, TrackingStatus.LOST), (lambda T: T, TrackingStatus.DEGRADED)):
        module = active()
        track(module, ROOM, poses[:10], odometry=odometry)
        for index in range(10, 20):
            observation = observe(
                ROOM, poses[index], index, odometry=odometry and odometry(poses[index])
            )
            tracking = module.track(replace(observation, depth_m=blind))
        assert tracking.status is status
    assert np.linalg.norm(tracking.T_local_base[:3, 3] - poses[-1][:3, 3]) < 0.01


def test_turning_round_once_closes_and_the_past_is_revised():
    poses = [se3.from_xy_yaw(0.0, 0.0, 2 * np.pi * index / 80) for index in range(100)]
    module = active()
    trackings = track(module, ROOM, poses)
    revisions = [tracking.revision for tracking in trackings]
    assert revisions == sorted(revisions) and revisions[-1] > 0
    revised = module.get_trajectory()
    np.testing.assert_array_equal(revised.stamps_ns, [tracking.stamp_ns for tracking in trackings])
    truth = np.array([se3.inverse(poses[0]) @ T for T in poses])
    assert np.linalg.norm(revised.positions_m - truth[:, :3, 3], axis=1).max() < 0.015


def test_rounding_does_not_grow_from_keyframe_to_keyframe():
    slam, poses = active(), [se3.from_xy_yaw(0.0, 0.0, 0.2 * k) for k in range(63)]
    for tracking in track(slam, ROOM, poses):  # twice round: many keyframes, moved many times
        rotation = tracking.T_local_base[:3, :3]
        assert np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-12


def test_standing_still_needs_no_more_memory():
    module = active()
    track(module, ROOM, [se3.identity()] * 20)
    assert module.keyframe_count == 1


def test_map_lies_on_the_walls():
    module = active()
    track(module, ROOM, [handheld(index) for index in range(30)])
    points = module.get_map().points.points
    room = se3.apply(handheld(0), points.astype(np.float64))
    gaps = np.min([d - room @ np.array(n) for *n, d in ROOM], axis=0)
    assert len(points) > 3000
    assert np.quantile(np.abs(gaps), 0.95) < 0.02


@pytest.mark.parametrize(("column", "row"), [(-0.9, 5.0), (5.0, -0.9), (-0.9, -0.9)])
def test_points_beyond_the_first_column_or_row_are_out_of_view(column, row):
    grid = DepthSurfaceReader(CAMERA).grid
    ray = [(column - grid.cx) / grid.fx, (row - grid.cy) / grid.fy, 1.0]
    cells, seen = grid.index(np.array([ray, grid.rays[0], grid.rays[-1]], np.float32))
    np.testing.assert_array_equal(seen, [False, True, True])
    np.testing.assert_array_equal(cells, [0, 0, len(grid.rays) - 1])


def test_two_runs_are_identical_to_the_bit():
    poses = [handheld(index) for index in range(20)]
    runs = [[t.T_local_base for t in track(active(), ROOM, poses)] for _ in range(2)]
    np.testing.assert_array_equal(runs[0], runs[1])


def test_mounted_camera_gives_the_motion_of_base():
    mounted = se3.from_parts(se3.so3_exp(np.array([0.1, 0.2, 0.3])), np.array([0.2, 0.1, 0.3]))
    camera = replace(CAMERA, T_base_cam=mounted @ CAMERA.T_base_cam)
    poses = [handheld(index) for index in range(30)]
    module = active(Rig(sensors=RIG.sensors, camera=camera))
    trackings = track(module, ROOM, [T @ mounted for T in poses])
    assert max(errors_m(trackings, poses)) < 0.01


def test_missing_depth_is_missing_also_where_the_range_begins_at_0():
    poses = [handheld(index) for index in range(5)]
    module = active(Rig(sensors=RIG.sensors, camera=replace(CAMERA, depth_range_m=(0.0, 8.0))))
    holes = np.random.default_rng(0).random((240, 320)) < 0.1
    for index, T in enumerate(poses):
        observation = observe(ROOM, T, index)
        depth_m = np.where(holes, 0, observation.depth_m).astype(np.float32)
        tracking = module.track(replace(observation, depth_m=depth_m))
        assert tracking.status is TrackingStatus.TRACKING


def test_settings_and_images_out_of_range_are_named():
    for name, value in (("weak_ratio", 0.0), ("cloud_voxel_m", -1.0), ("matched_min_ratio", 2.0)):
        with pytest.raises(ConfigError, match=name):
            active(**{name: value})
    with pytest.raises(InputError, match=r"depth_m: expected \(240, 320\), got \(4, 4\)"):
        active().track(
            replace(observe(ROOM, se3.identity(), 0), depth_m=np.zeros((4, 4), np.float32))
        )
    with pytest.raises(InputError, match="camera"):
        active(Rig(sensors=frozenset({Sensor.DEPTH})))


@pytest.mark.parametrize(
    ("folder", "camera", "scale", "bound_m"),
    [
        ("tum_fr1_rpy", {}, 5000.0, 0.04),
        ("7scenes_redkitchen", {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0}, 1000.0, 0.03),
    ],
)
def test_start_of_a_real_recording_is_followed_by_depth_alone(
    shared_data, folder, camera, scale, bound_m
):
    source = TumRgbd(str(shared_data / folder), camera, scale, [0.3, 8.0], 0.02)
    module = active(source.rig)
    told = []
    for observation in source:
        told.append(module.track(replace(observation, image_bgr=None)))
        if len(told) == 80:
            break
    assert {tracking.status for tracking in told} == {TrackingStatus.TRACKING}
    estimate = Trajectory(
        stamps_ns=np.array([tracking.stamp_ns for tracking in told]),
        T_world_base=np.array([tracking.T_local_base for tracking in told]),
    )
    errors = absolute_errors(estimate, source.ground_truth().trajectory, 0.02)
    assert len(errors.errors_m) == 80
    assert errors.rmse_m < bound_m


def beside_by_5_cm(samples, prior, known, grid, *, weak_ratio):
    """A registration along the image's rows, a direction that it hardly measures."""
    T_local_cam = prior.T_local_cam @ se3.from_xy_yaw(0.05, 0.0, 0.0)
    return SurfaceRegistration(
        T_local_cam,
        np.diag([1 / 0.05**2, 1e6, 1e6, 1e6, 1e6, 1e6]),  # axes of the camera
        common_ratio=1.0,
        misfit=1.0,
        T_keyframe_cam=T_local_cam[None],
        localizability=samples.localizability(),
        matched_ratio=1.0,
        seen=len(samples),
        matched=len(samples),
    )


@pytest.mark.parametrize("is_guessed", [False, True])
def test_a_registration_that_hardly_measures_a_direction_leaves_it_to_tracking(
    monkeypatch, is_guessed
):
    """Along a wall, unless tracking guessed it; it finds a keyframe 0.05 m from where it was."""
    reader = DepthSurfaceReader(CAMERA)
    surface = reader.read(depth_image(WALL, se3.identity()))
    keyframes = KeyframeMap(reader.grid)
    graph = DepthPoseGraph(keyframes, weak_ratio=0.005)
    monkeypatch.setattr("sceneslam.modules.slam.depth.pose_graph.register", beside_by_5_cm)
    tracked = [CAMERA.T_base_cam, se3.from_xy_yaw(0.0, 0.2, 0.0) @ CAMERA.T_base_cam]
    for T_local_cam in tracked:
        known = np.diag([0.2**2 if is_guessed else 1e-6, *[1e-6] * 5])
        graph.connect(keyframes.add(surface, T_local_cam), known, tracked_by=0)
    graph.finish()
    moved = se3.inverse(tracked[1]) @ keyframes[1].T_local_cam
    low, high = (0.04, 0.05) if is_guessed else (0.0, 0.005)
    assert low < moved[0, 3] < high


def test_a_keyframe_stays_beside_the_one_that_it_was_tracked_by(monkeypatch):
    """The second of three was guessed, and is found 0.05 m away; the first tracked the third."""
    reader = DepthSurfaceReader(CAMERA)
    surface = reader.read(depth_image(WALL, se3.identity()))
    keyframes = KeyframeMap(reader.grid)
    graph = DepthPoseGraph(keyframes, weak_ratio=0.005)
    register = "sceneslam.modules.slam.depth.pose_graph.register"
    known, guessed = (np.diag([variance, *[1e-6] * 5]) for variance in (1e-6, 0.2**2))
    monkeypatch.setattr(register, beside_by_5_cm)
    for covariance in (known, guessed):
        graph.connect(keyframes.add(surface, CAMERA.T_base_cam), covariance, tracked_by=0)
    graph.advance()
    monkeypatch.setattr(register, lambda *_, **__: None)
    graph.connect(keyframes.add(surface, CAMERA.T_base_cam), known, tracked_by=0)
    graph.finish()
    moved = [se3.inverse(CAMERA.T_base_cam) @ keyframes[k].T_local_cam for k in (1, 2)]
    assert moved[0][0, 3] > 0.04
    assert abs(moved[1][0, 3]) < 0.005
