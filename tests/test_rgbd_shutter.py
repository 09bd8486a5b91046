"""The rgbd module learns from its residuals that the camera's rows are read one by one."""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_features import empty_map, features_at, random_descriptors

from sceneslam.modules.slam.rgbd.locate.pose_solver import Measurements, PoseSolver
from sceneslam.modules.slam.rgbd.locate.residuals import Sightings
from sceneslam.modules.slam.rgbd.map.keyframes import NO_LANDMARK, Keyframe, nothing_seen
from sceneslam.modules.slam.rgbd.see.shutter import RollingShutter, Turning, moves_px_per_s
from sceneslam.modules.slam.rgbd.see.turn_rate import measured_rate
from sceneslam.motion.predictor import Predictor
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor

CAMERA = Camera(size_wh=(640, 480), fx=525.0, fy=520.0, cx=319.0, cy=241.0, T_base_cam=np.eye(4))
LANDMARKS = 300


def pixels(points_cam):
    focal_px, centre_px = np.array([CAMERA.fx, CAMERA.fy]), np.array([CAMERA.cx, CAMERA.cy])
    return points_cam[:, :2] / points_cam[:, 2:] * focal_px + centre_px


def rolled(points_cam, rate_cam, readout_s):
    """Return where a camera at the identity sees points while it turns and reads."""
    uv_px = pixels(points_cam)
    for _ in range(5):  # when a row is read depends on where its point then is
        late_s = readout_s * (uv_px[:, 1] / CAMERA.size_wh[1] - 0.5)
        turned = [se3.so3_exp(-rate_cam * s) @ p for s, p in zip(late_s, points_cam, strict=True)]
        uv_px = pixels(np.stack(turned))
    return uv_px


def scene(rng):
    uv_px = rng.uniform([20, 20], [620, 460], (LANDMARKS, 2))
    z = rng.uniform(1.0, 4.0, LANDMARKS)
    rays = (uv_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    return np.column_stack([rays, np.ones(LANDMARKS)]) * z[:, None]


def after_watching(readout_s, *, images=60):
    """Return a shutter that saw a camera turn about changing axes, and the last image."""
    rng = np.random.default_rng(0)
    shutter, solver, points = RollingShutter(CAMERA), PoseSolver(CAMERA, seed=0), scene(rng)
    for _ in range(images):
        rate_cam = rng.normal(0, 1.0, 3)
        uv_px = rolled(points, rate_cam, readout_s) + rng.normal(0, 0.5, (LANDMARKS, 2))
        features = features_at(uv_px, random_descriptors(rng, LANDMARKS))
        straight = shutter.straighten(features, rate_cam)
        seen = Sightings(
            uv_px=straight.uv_px,
            sigma_px=np.ones(LANDMARKS),
            depth_m=points[:, 2],
            inverse_depth_sigma_per_m=np.full(LANDMARKS, 0.003),
        )
        estimate = solver.refine(
            Measurements(points_local=points, seen=seen, images=np.ones(len(points), np.int64)),
            np.eye(4),
        )
        slope_px = moves_px_per_s(CAMERA, straight.uv_px[estimate.inliers], rate_cam)
        shutter.learn(estimate.linearised, slope_px)
        shutter.step_s()
    return shutter, points


@pytest.mark.parametrize("readout_s", [0.026, 0.012, -0.02])
def test_readout_is_learnt_with_its_sign(readout_s):
    shutter, _ = after_watching(readout_s)
    assert shutter.readout_s == pytest.approx(readout_s, abs=0.002)


def test_features_are_put_where_the_middle_row_would_have_seen_them():
    shutter, points = after_watching(0.026)
    rate_cam = np.array([0.5, -1.0, 0.8])
    uv_px = rolled(points, rate_cam, 0.026)
    features = features_at(uv_px, np.zeros((LANDMARKS, 32), np.uint8))
    straight = shutter.straighten(features, rate_cam).uv_px
    wrong_px = np.linalg.norm(uv_px - pixels(points), axis=1)
    left_px = np.linalg.norm(straight - pixels(points), axis=1)
    assert np.median(wrong_px) > 3.0
    assert np.median(left_px) < 0.15 * np.median(wrong_px)


def estimate_of(points, uv_px):
    """Return the pose that pixels of points lead to."""
    seen = Sightings(
        uv_px=uv_px,
        sigma_px=np.ones(LANDMARKS),
        depth_m=points[:, 2],
        inverse_depth_sigma_per_m=np.full(LANDMARKS, 0.003),
    )
    measured = Measurements(points_local=points, seen=seen, images=np.ones(len(points), np.int64))
    return PoseSolver(CAMERA, seed=0).refine(measured, np.eye(4))


def test_rows_tell_how_fast_a_camera_turned_of_which_nothing_is_known():
    shutter, points = after_watching(0.026)
    rate_cam = np.array([0.6, -0.5, 0.4])
    uv_px = rolled(points, rate_cam, 0.026)
    estimate = estimate_of(points, uv_px)
    found, _ = shutter.turn(estimate.linearised, uv_px[estimate.inliers], np.zeros(3), 1.0)
    assert found == pytest.approx(rate_cam, abs=0.15)
    kept, _ = shutter.turn(estimate.linearised, uv_px[estimate.inliers], np.zeros(3), 1e-3)
    assert np.abs(kept).max() < 0.01


def test_map_made_while_the_camera_turned_is_straightened_when_the_readout_is_known():
    rng, rate_cam = np.random.default_rng(1), np.array([0.5, -1.0, 0.3])
    points, visual_map = scene(rng), empty_map(CAMERA)
    uv_px = rolled(points, rate_cam, 0.026)
    estimate = estimate_of(points, uv_px)
    slope_px = moves_px_per_s(CAMERA, uv_px[estimate.inliers], rate_cam)
    twist_per_s = RollingShutter(CAMERA).learn(estimate.linearised, slope_px)
    keyframe = Keyframe(
        stamp_ns=0,
        T_local_base=estimate.T_local_base,
        features=features_at(uv_px, random_descriptors(rng, LANDMARKS), depth_m=points[:, 2]),
        landmark_ids=np.full(LANDMARKS, NO_LANDMARK),
        view=nothing_seen(),
        turning=Turning(rate_cam=rate_cam, twist_per_s=twist_per_s),
    )
    visual_map.insert(keyframe, deep_rows=np.zeros(0, np.int64))
    ids = keyframe.landmark_ids

    def off_m():
        pose_m = np.linalg.norm(keyframe.T_local_base[:3, 3])
        gaps_m = np.linalg.norm(visual_map.landmarks.points_local[ids] - points, axis=1)
        return np.array([pose_m, np.median(gaps_m)])

    wrong_m = off_m()
    visual_map.straighten(0.026)
    assert (off_m() < 0.35 * wrong_m).all()
    left_px = np.linalg.norm(keyframe.features.uv_px - pixels(points), axis=1)
    assert np.median(left_px) < 0.15 * np.median(np.linalg.norm(uv_px - pixels(points), axis=1))


def test_global_shutter_and_camera_at_rest_are_left_alone():
    shutter, points = after_watching(0.0)
    features = features_at(pixels(points), np.zeros((LANDMARKS, 32), np.uint8))
    assert abs(shutter.readout_s) < 0.001
    learnt, _ = after_watching(0.026)
    assert np.array_equal(learnt.straighten(features, np.zeros(3)).uv_px, features.uv_px)
    none = replace(features, uv_px=features.uv_px[:0], levels=features.levels[:0])
    assert len(learnt.straighten(none, np.ones(3))) == 0


def test_the_turn_rate_after_a_gap_is_that_of_the_newest_samples():
    """The camera was away for five seconds, in which it turned; it rests since one second."""
    times_s = np.arange(-5.0, 0.0, 0.01)
    gyro = np.column_stack([times_s, np.zeros((500, 2)), np.where(times_s < -1.0, 0.8, 0.0)])
    seen = Observation(stamp_ns=0, gyro_base=gyro)
    found = measured_rate(seen, Predictor(Rig(sensors=frozenset({Sensor.GYRO}))), se3.identity())
    np.testing.assert_array_equal(found.rate_base, 0.0)
