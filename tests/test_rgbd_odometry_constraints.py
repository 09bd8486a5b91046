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


def keyframes(*, stretches=(0, 0, 0, 0)):
    """Return keyframes on a line, half a metre apart, as odometry alone has them."""
    made = {}
    for k, stretch in enumerate(stretches):
        one = keyframe_at(
            np.eye(4), np.zeros((0, 3)), np.zeros((0, 32), np.uint8), np.zeros(0, int)
        )
        one.T_local_base = se3.from_xy_yaw(0.5 * k, 0.1, 0.2)
        one.odometry = odometry(one.T_local_base, k, stretch=stretch)
        made[k] = one
    return made


def odometry(T_odom_base, k, *, stretch=0):
    """Return the odometry's pose of the k-th keyframe: 1 cm and 2 mrad less sure than the last."""
    variance = k * np.array([0.01**2, 0.002**2])
    return OdometryPose(T_odom_base=T_odom_base, stretch=stretch, variance=variance)


def test_odometry_constrains_distance_and_turn_of_keyframes_that_follow_each_other():
    constraints = odometry_constraints(keyframes(), CAMERA.T_base_cam)
    assert [pair for pair, _ in constraints] == [(k, k + 1) for k in (0, 0, 1, 1, 2, 2)]
    (_, distance), (_, turn) = constraints[2:4]
    T_base = CAMERA.T_base_cam @ distance.T_one_other @ se3.inverse(CAMERA.T_base_cam)
    assert np.linalg.norm(T_base[:3, 3]) == pytest.approx(0.5)
    to_cam = se3.adjoint(se3.inverse(CAMERA.T_base_cam))
    by_base = [constraint.root @ to_cam for constraint in (distance, turn)]
    np.testing.assert_allclose(np.diag(by_base[0]), [100.0] * 3 + [0.0] * 3, rtol=1e-3)
    np.testing.assert_allclose(np.diag(by_base[1]), [0.0] * 3 + [1000.0] * 3, rtol=1e-2)


def test_odometry_constrains_nothing_beyond_a_gap():
    found = odometry_constraints(keyframes(stretches=(0, 0, 1, 1)), CAMERA.T_base_cam)
    assert {pair for pair, _ in found} == {(0, 1), (2, 3)}


def test_keyframes_that_are_far_apart_are_constrained_too():
    keys = {k: keyframe for k, keyframe in keyframes(stretches=(0,) * 20).items() if k in (0, 19)}
    assert {pair for pair, _ in odometry_constraints(keys, CAMERA.T_base_cam)} == {(0, 19)}


def test_a_distance_that_the_keyframes_contradict_weighs_next_to_nothing():
    keys = keyframes()
    honest = odometry_constraints(keys, CAMERA.T_base_cam)
    for key in list(keys)[2:]:
        keys[key].T_local_base = se3.from_xy_yaw(0.5 * key - 0.1, 0.1, 0.2)  # wheels slip by 10 cm
    slipping = odometry_constraints(keys, CAMERA.T_base_cam)
    weights = [
        np.linalg.norm(b.root) / np.linalg.norm(a.root)
        for (_, a), (_, b) in zip(honest, slipping, strict=True)
    ]
    assert weights == pytest.approx([1.0, 1.0, 9 / 109, 1.0, 1.0, 1.0], rel=0.01)


def test_constraints_bring_back_a_scale_that_images_alone_cannot_tell():
    bundle = exact_bundle(np.random.default_rng(0))
    poses, count = true_poses(), len(bundle.T_local_cam)
    keys = dict(enumerate(keyframes(stretches=(0,) * count).values()))
    for k, T_local_cam in enumerate(poses):
        keys[k].odometry = odometry(T_local_cam @ se3.inverse(CAMERA.T_base_cam), k)
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
    for k, T_local_cam in enumerate(shrunk):
        keys[k].T_local_base = T_local_cam @ se3.inverse(CAMERA.T_base_cam)
    constraints = PoseConstraints.of(odometry_constraints(keys, CAMERA.T_base_cam))
    assert length_m(adjust(CAMERA, replace(wrong, constraints=constraints))) == pytest.approx(
        true_m, rel=0.05
    )


def found_at(T_local_base):
    """Return a pose that an image found, its deviation 2 cm and 2 degrees / 1.8."""
    nothing = np.zeros(0, int)
    estimate = PoseEstimate(
        T_local_base=T_local_base,
        covariance=0.02**2 * np.eye(6),
        prior=np.zeros((6, 6)),
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


def together(fix):
    """Return how an image with such a fix and a prior are solved: errors are small here."""

    def solved(prior):
        by_image = np.linalg.inv(fix.estimate.covariance)
        covariance = np.linalg.inv(by_image + prior.information)
        off = covariance @ by_image @ prior.off(fix.estimate.T_local_base)
        T_local_base = prior.T_local_base @ se3.exp(off)
        estimate = replace(fix.estimate, T_local_base=T_local_base, covariance=covariance)
        return replace(fix, estimate=estimate)

    return solved


def fused(T_found, *, turn_radps=0.0, duration_s=0.1):
    """Return the fix at T_found, fused with a prediction of 1 m by wheels, or None."""
    prediction = Prediction(
        T_local_base=se3.from_xy_yaw(1.0, 0.0, 0.0), covariance=0.04**2 * np.eye(6), motion=None
    )
    fix = found_at(T_found)
    return led(fix, prediction, together(fix), turn_radps=turn_radps, duration_s=duration_s)


@pytest.mark.parametrize(
    ("found_m", "expected_m"),
    [(1.1, 1.05), (1.3, 1.0 + 0.3 * 116 / 132), (6.0, None)],
    ids=["equally certain", "wheels slip", "no robot moves so far"],
)
def test_a_pose_is_fused_with_odometry_and_wheels_that_contradict_it_may_slip(found_m, expected_m):
    fix = fused(se3.from_xy_yaw(found_m, 0.0, 0.0))
    if expected_m is None:
        assert fix is None
        return
    assert fix.estimate.T_local_base[0, 3] == pytest.approx(expected_m, abs=0.001)
    assert fix.estimate.covariance[3, 3] == pytest.approx(0.04**2 / 2)  # turns do not slip
    by_image = np.linalg.inv(fix.estimate.covariance) - fix.estimate.prior
    assert np.linalg.inv(by_image) == pytest.approx(0.04**2 * np.eye(6))  # images err alike


@pytest.mark.parametrize(
    ("turn_radps", "is_taken"),
    [(0.0, False), (4.0, True), (None, True)],
    ids=["driving straight", "in a turn, clocks may differ", "without a gyro"],
)
def test_a_pose_that_contradicts_the_gyro_is_not_taken(turn_radps, is_taken):
    T_found = se3.from_xy_yaw(1.0, 0.0, 0.4)
    assert (fused(T_found, turn_radps=turn_radps, duration_s=0.3) is not None) is is_taken


@pytest.mark.parametrize(
    ("explained", "is_taken"),
    [(97, True), (60, False)],
    ids=["a far wall", "near landmarks tell that it is not there"],
)
def test_an_image_that_contradicts_the_gyro_is_solved_together_with_it(explained, is_taken):
    fix = replace(found_at(se3.from_xy_yaw(0.7, 2.3, -0.2)), landmark_ids=np.arange(100))
    there = replace(found_at(se3.from_xy_yaw(1.02, 0.0, 0.0)), landmark_ids=np.arange(explained))
    prediction = Prediction(
        T_local_base=se3.from_xy_yaw(1.0, 0.0, 0.0), covariance=1e-4 * np.eye(6), motion=None
    )
    found = led(fix, prediction, lambda prior: there, turn_radps=0.1, duration_s=0.1)
    assert (found is not None) is is_taken
    if is_taken:
        np.testing.assert_allclose(found.estimate.T_local_base, there.estimate.T_local_base)
        assert len(found.landmark_ids) == explained


def test_a_pose_far_from_what_odometry_leaves_open_is_not_taken():
    fix = replace(found_at(se3.from_xy_yaw(0.7, 2.3, -0.2)), landmark_ids=np.arange(100))
    prediction = Prediction(
        T_local_base=se3.from_xy_yaw(1.0, 0.0, 0.0), covariance=1e-4 * np.eye(6), motion=None
    )
    assert led(fix, prediction, lambda prior: fix, turn_radps=0.1, duration_s=0.1) is None


def test_images_that_show_a_turn_by_a_shift_are_corrected_by_the_gyro():
    fix = found_at(se3.from_xy_yaw(1.0, 0.6, -0.06))  # a wall 10 m ahead looks the same
    along = np.array([0, 10.0, 0, 0, 0, -1.0])
    covariance = 0.02**2 * np.eye(6) + 0.02**2 * np.outer(along, along)
    fix = replace(fix, estimate=replace(fix.estimate, covariance=covariance))
    prediction = Prediction(
        T_local_base=se3.from_xy_yaw(1.0, 0.0, 0.0),
        covariance=np.diag([0.01**2] * 3 + [0.001**2] * 3),
        motion=None,
    )
    found = led(fix, prediction, together(fix), turn_radps=0.0, duration_s=0.1)
    found = found.estimate.T_local_base
    assert abs(se3.yaw_rad(found)) < 0.001 and abs(found[1, 3]) < 0.02
