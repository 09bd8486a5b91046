"""Without depth, wheels tell how far keyframes are apart; landmarks alone lose the scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_rgbd_bundle import CAMERA, exact_bundle, keyframe_at, true_poses

from sceneslam.modules.slam.rgbd.adjust.bundle import adjust
from sceneslam.modules.slam.rgbd.adjust.odometry_constraints import led, odometry_constraints
from sceneslam.modules.slam.rgbd.adjust.pose_constraints import PoseConstraints
from sceneslam.modules.slam.rgbd.locate.localizer import VisualFix
from sceneslam.modules.slam.rgbd.locate.pose_solver import PoseEstimate
from sceneslam.modules.slam.rgbd.map.keyframes import OdometryPose
from sceneslam.motion.predictor import Prediction
from sceneslam.types import se3


def keyframes(*, is_monocular=True, stretches=(0, 0, 0, 0)):
    """Return keyframes on a line, half a metre apart, as odometry alone has them."""
    made = {}
    for k, stretch in enumerate(stretches):
        one = keyframe_at(
            np.eye(4), np.zeros((0, 3)), np.zeros((0, 32), np.uint8), np.zeros(0, int)
        )
        one.is_monocular = is_monocular
        one.odometry = OdometryPose(T_odom_base=se3.from_xy_yaw(0.5 * k, 0.1, 0.2), stretch=stretch)
        made[k] = one
    return made


def test_odometry_constrains_keyframes_that_follow_each_other_without_depth():
    constraints = odometry_constraints(keyframes(), CAMERA.T_base_cam)
    assert list(constraints) == [(0, 1), (1, 2), (2, 3)]
    T_base = CAMERA.T_base_cam @ constraints[1, 2].T_one_other @ se3.inverse(CAMERA.T_base_cam)
    assert np.linalg.norm(T_base[:3, 3]) == pytest.approx(0.5)


def test_odometry_constrains_nothing_that_has_depth_or_lies_beyond_a_gap():
    assert not odometry_constraints(keyframes(is_monocular=False), CAMERA.T_base_cam)
    assert list(odometry_constraints(keyframes(stretches=(0, 0, 1, 1)), CAMERA.T_base_cam)) == [
        (0, 1),
        (2, 3),
    ]


def test_constraints_bring_back_a_scale_that_images_alone_cannot_tell():
    bundle = exact_bundle(np.random.default_rng(0))
    poses, count = true_poses(), len(bundle.T_local_cam)
    keys = dict(enumerate(keyframes(stretches=(0,) * count).values()))
    for key, T_local_cam in zip(keys.values(), poses, strict=True):
        T_local_base = T_local_cam @ se3.inverse(CAMERA.T_base_cam)
        key.odometry = OdometryPose(T_odom_base=T_local_base, stretch=0)
    shrunk = bundle.T_local_cam.copy()
    first_m = shrunk[0, :3, 3]
    shrunk[:, :3, 3] = first_m + 0.8 * (shrunk[:, :3, 3] - first_m)
    points = first_m + 0.8 * (bundle.points_local - first_m)
    no_depth = replace(bundle.seen, depth_m=np.zeros_like(bundle.seen.depth_m))
    is_free = np.arange(count) > 0
    wrong = replace(bundle, T_local_cam=shrunk, points_local=points, seen=no_depth, is_free=is_free)

    def length_m(adjusted):
        T_local_cam = adjusted.bundle.T_local_cam
        return np.linalg.norm(T_local_cam[-1, :3, 3] - T_local_cam[0, :3, 3])

    true_m = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert length_m(adjust(CAMERA, wrong)) == pytest.approx(0.8 * true_m, rel=0.05)
    constraints = PoseConstraints.of(odometry_constraints(keys, CAMERA.T_base_cam))
    assert length_m(adjust(CAMERA, replace(wrong, constraints=constraints))) == pytest.approx(
        true_m, rel=0.05
    )


def found_at(x_m):
    """Return a pose that an image found, its deviation 2 cm."""
    nothing = np.zeros(0, int)
    estimate = PoseEstimate(
        T_local_base=se3.from_xy_yaw(x_m, 0.0, 0.0),
        covariance=0.02**2 * np.eye(6),
        inliers=nothing > 0,
        depth_inliers=nothing > 0,
        depth_agreement_ratio=1.0,
        linearised=None,
    )
    return VisualFix(
        estimate=estimate,
        landmark_ids=nothing,
        feature_rows=nothing,
        deep_rows=nothing,
        expected_ids=nothing,
    )


@pytest.mark.parametrize(
    ("found_m", "scale_m", "expected_m"),
    [(1.1, 0.0, 1.05), (1.1, 1.0, 1.0), (1.5, 0.0, 1.5)],
    ids=["as sure as each other", "scale unknown", "wheels slip"],
)
def test_a_pose_without_depth_is_led_by_odometry_unless_they_contradict(
    found_m, scale_m, expected_m
):
    T_predicted, known = se3.from_xy_yaw(1.0, 0.0, 0.0), 0.04**2 * np.eye(6)
    prediction = Prediction(T_local_base=T_predicted, covariance=known, motion=None)
    fix = led(found_at(found_m), prediction, np.diag([scale_m**2, 0.0, 0.0]))
    assert fix.estimate.T_local_base[0, 3] == pytest.approx(expected_m, abs=0.001)
    is_image_alone = expected_m == found_m
    expected_m2 = 0.02**2 if is_image_alone else 0.04**2 / 2
    assert fix.estimate.covariance[1, 1] == pytest.approx(expected_m2)
