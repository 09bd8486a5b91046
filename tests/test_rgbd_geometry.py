"""How the rgbd module matches descriptors and solves for the pose."""

from dataclasses import replace

import numpy as np
from rgbd_features import features_at, random_descriptors

from sceneslam.modules.slam.rgbd.locate.matching import match_anywhere, match_near
from sceneslam.modules.slam.rgbd.locate.pose_errors import PoseErrors
from sceneslam.modules.slam.rgbd.locate.pose_solver import Measurements, PoseSolver, Prior
from sceneslam.modules.slam.rgbd.locate.residuals import Sightings
from sceneslam.modules.slam.rgbd.map.visual_map import ExpectedLandmarks
from sceneslam.types import se3
from sceneslam.types.rig import Camera

CAMERA = Camera(size_wh=(640, 480), fx=525.0, fy=520.0, cx=319.0, cy=241.0)


def with_flipped_bits(descriptors, bits):
    flipped = descriptors.copy()
    flipped[:, :bits] ^= 1
    return flipped


def scene(rng, count=200):
    """Return T_local_base and exact measurements of points in front of it."""
    T_local_base = se3.exp(np.array([0.3, -0.2, 0.1, 0.05, -0.1, 0.2]))
    depth_m = rng.uniform(0.8, 4.0, count)
    uv_px = rng.uniform([0, 0], CAMERA.size_wh, (count, 2))
    rays = (uv_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points_cam = np.column_stack([rays, np.ones(count)]) * depth_m[:, None]
    measured = Measurements(
        points_local=se3.apply(T_local_base @ CAMERA.T_base_cam, points_cam),
        seen=Sightings(
            uv_px=uv_px,
            sigma_px=np.ones(count),
            depth_m=depth_m,
            inverse_depth_sigma_per_m=np.full(count, 0.003),
        ),
        images=np.ones(count, np.int64),
    )
    return T_local_base, measured


def changed(measured, **fields):
    outer = {name: fields.pop(name) for name in ("points_local", "images") if name in fields}
    return replace(measured, seen=replace(measured.seen, **fields), **outer)


def expected_at(uv_px, descriptors):
    """Return landmarks that are expected at pixels of level 0."""
    count = len(descriptors)
    return ExpectedLandmarks(
        ids=np.arange(count),
        uv_px=np.asarray(uv_px, float),
        levels=np.zeros(count, np.int64),
        descriptors=descriptors,
    )


def test_match_near_finds_every_landmark_close_to_its_prediction():
    rng = np.random.default_rng(0)
    descriptors, uv_px = random_descriptors(rng, 300), rng.uniform(0, 480, (300, 2))
    order = rng.permutation(300)
    features = features_at(uv_px[order], with_flipped_bits(descriptors[order], 20))
    predicted = uv_px + rng.uniform(-5, 5, (300, 2))
    matches = match_near(expected_at(predicted, descriptors), features, radius_px=10)
    assert len(matches) == 300
    assert (order[matches.feature_rows] == matches.landmark_rows).all()


def test_match_near_ignores_twins_outside_the_radius_and_on_other_levels():
    descriptors = random_descriptors(np.random.default_rng(0), 1)
    far = features_at([[111.0, 100.0]], descriptors)
    other_level = features_at([[101.0, 100.0]], descriptors, levels=np.array([3]))
    expected = expected_at([[100.0, 100.0]], descriptors)
    assert len(match_near(expected, far, radius_px=10)) == 0
    assert len(match_near(expected, other_level, radius_px=10)) == 0
    assert len(match_near(expected, far, radius_px=12)) == 1


def test_match_near_refuses_what_two_features_resemble_alike():
    descriptors = random_descriptors(np.random.default_rng(0), 1)
    twins = features_at([[100.0, 100.0], [104.0, 100.0]], np.repeat(descriptors, 2, axis=0))
    expected = expected_at([[102.0, 100.0]], descriptors)
    assert len(match_near(expected, twins, radius_px=10)) == 0


def test_match_near_equals_the_brute_force_search():
    rng = np.random.default_rng(3)
    descriptors = random_descriptors(rng, 150)
    uv_px = rng.uniform(-20, 660, (150, 2))
    features = features_at(
        uv_px[::-1] + rng.uniform(-25, 25, (150, 2)), with_flipped_bits(descriptors[::-1], 10)
    )
    matches = match_near(expected_at(uv_px, descriptors), features, radius_px=20)
    apart = np.linalg.norm(uv_px - features.uv_px[::-1], axis=1)
    assert matches.landmark_rows.tolist() == np.flatnonzero(apart <= 20).tolist()


def test_unrelated_descriptors_do_not_match_anywhere():
    rng = np.random.default_rng(1)
    features = features_at(rng.uniform(0, 480, (500, 2)), random_descriptors(rng, 500))
    assert len(match_anywhere(random_descriptors(rng, 500), features)) == 0
    assert len(match_anywhere(features.descriptors, features)) == 500


def test_pose_is_found_despite_a_third_of_outliers():
    rng = np.random.default_rng(0)
    T_local_base, measured = scene(rng)
    uv_px = measured.seen.uv_px + rng.normal(0, 0.5, (200, 2))
    uv_px[:66] = rng.uniform([0, 0], CAMERA.size_wh, (66, 2))
    measured = changed(measured, uv_px=uv_px)
    solver = PoseSolver(CAMERA, seed=0)
    coarse = solver.search(measured)
    assert coarse is not None
    estimate = solver.refine(measured, coarse.T_local_base)
    assert estimate is not None
    assert np.linalg.norm(se3.log(se3.inverse(T_local_base) @ estimate.T_local_base)) < 0.005
    assert estimate.inliers[66:].mean() > 0.95
    assert estimate.inliers[:66].mean() < 0.1


def passed(*, moved_px, room_images):
    """Return T_local_base and a view in which a new thing before most of the room moved."""
    T_local_base, measured = scene(rng := np.random.default_rng(0))
    uv_px = measured.seen.uv_px + rng.normal(0, 0.5, (200, 2))
    uv_px[:110, 0] += moved_px
    images = np.repeat([1, room_images], [110, 90])
    return T_local_base, changed(measured, uv_px=uv_px, images=images)


def off(found, T_local_base):
    return np.linalg.norm(se3.log(se3.inverse(T_local_base) @ found.T_local_base))


def test_a_thing_that_moves_before_a_known_room_moves_no_camera():
    """The thing shows more landmarks than the room, found when its image became a keyframe."""
    for room_images, is_known in ((5, True), (1, False)):
        T_local_base, measured = passed(moved_px=13.0, room_images=room_images)
        found = PoseSolver(CAMERA, seed=0).search(measured)
        assert (off(found, T_local_base) < 0.005) == is_known
        T_local_base, measured = passed(moved_px=4.0, room_images=room_images)
        found = PoseSolver(CAMERA, seed=0).approach(measured, T_local_base)
        assert (off(found, T_local_base) < 0.001) == is_known


def few_at_the_edge(rng, moved_px=0.0):
    """Return T_local_base and a view of 40 old landmarks at its left edge, and 400 of two images.

    The old ones have moved.
    """
    T_local_base, measured = scene(rng, 440)
    uv_px = measured.seen.uv_px.copy()
    uv_px[:40, 0] *= 0.2
    rays = (uv_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points_cam = np.column_stack([rays, np.ones(440)]) * measured.seen.depth_m[:, None]
    points_local = se3.apply(T_local_base @ CAMERA.T_base_cam, points_cam)
    uv_px += rng.normal(0, 1.0, (440, 2))
    uv_px[:40, 0] += moved_px
    images = np.repeat([12, 2], [40, 400])
    return T_local_base, changed(measured, uv_px=uv_px, points_local=points_local, images=images)


def test_a_few_proven_landmarks_at_the_edge_make_no_pose_worse_or_too_sure():
    """Those which agree are told by the covariance of the first pose."""
    errors = {True: [], False: []}
    for seed in range(40):
        T_local_base, measured = few_at_the_edge(np.random.default_rng(seed))
        measured = changed(measured, depth_m=np.zeros(440))
        for proven in errors:
            images = measured.images if proven else np.ones(440, np.int64)
            found = PoseSolver(CAMERA, seed=0).refine(
                changed(measured, images=images), T_local_base
            )
            twist = se3.log(se3.inverse(T_local_base) @ found.T_local_base)
            errors[proven].append(twist @ np.linalg.solve(found.covariance, twist))
    assert np.mean(errors[True]) < 1.3 * np.mean(errors[False])


def test_what_most_contradict_is_not_proven():
    T_local_base, measured = few_at_the_edge(np.random.default_rng(0), moved_px=12.0)
    found = PoseSolver(CAMERA, seed=0).refine(measured, T_local_base)
    assert found.inliers[40:].mean() > 0.9
    assert off(found, T_local_base) < 0.01
    T_local_base, measured = few_at_the_edge(np.random.default_rng(0), moved_px=30.0)
    assert off(PoseSolver(CAMERA, seed=0).search(measured), T_local_base) < 0.02


def test_pose_without_any_depth_is_still_found():
    T_local_base, measured = scene(np.random.default_rng(0))
    measured = changed(measured, depth_m=np.zeros(200))
    estimate = PoseSolver(CAMERA, seed=0).refine(measured, se3.identity() @ T_local_base)
    assert estimate is not None
    assert np.abs(estimate.T_local_base - T_local_base).max() < 1e-6
    assert estimate.depth_agreement_ratio == 1.0


def test_a_wall_whose_tilt_is_mistaken_moves_no_camera_that_a_gyro_leads():
    """Far away, a turn of the camera and a shift look like a tilt of the wall."""
    rng = np.random.default_rng(0)
    uv_px = rng.uniform([0, 0], CAMERA.size_wh, (200, 2))
    rays = (uv_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    points_cam = 10.0 * np.column_stack([rays, np.ones(200)])
    tilted_cam = points_cam.copy()
    tilted_cam[:, 2] += 0.05 * points_cam[:, 0]
    T_true = se3.identity()
    measured = Measurements(
        points_local=se3.apply(T_true @ CAMERA.T_base_cam, tilted_cam),
        seen=Sightings(
            uv_px=uv_px,
            sigma_px=np.full(200, 2.0),
            depth_m=np.zeros(200),
            inverse_depth_sigma_per_m=np.full(200, 0.003),
        ),
        images=np.ones(200, np.int64),
    )
    solver = PoseSolver(CAMERA, seed=0)
    deviations = np.array([0.05] * 3 + [0.001] * 3)
    prior = Prior(T_local_base=T_true, information=np.diag(deviations**-2.0))
    alone, led = (solver.refine(measured, T_true, given) for given in (None, prior))
    assert np.linalg.norm(alone.T_local_base[:3, 3]) > 0.4
    assert np.linalg.norm(led.T_local_base[:3, 3]) < 0.1
    turned_rad = [se3.rotation_angle_rad(one.T_local_base) for one in (alone, led)]
    assert turned_rad[0] > 0.04 and turned_rad[1] < 0.006
    assert (np.diag(led.covariance) < deviations**2).all()


def test_covariance_is_the_spread_of_the_estimates():
    solver, errors = PoseSolver(CAMERA, seed=0), []
    rng = np.random.default_rng(5)
    T_local_base, exact = scene(rng)
    for _ in range(150):
        inverse_depth = 1 / exact.seen.depth_m + rng.normal(0, 0.003, 200)
        measured = changed(
            exact, uv_px=exact.seen.uv_px + rng.normal(0, 1, (200, 2)), depth_m=1 / inverse_depth
        )
        estimate = solver.refine(measured, T_local_base)
        assert estimate is not None
        errors.append(se3.log(se3.inverse(T_local_base) @ estimate.T_local_base))
    spread = np.std(errors, axis=0)
    claimed = np.sqrt(np.diag(estimate.covariance))
    assert (spread / claimed < 1.4).all()
    assert (spread / claimed > 0.7).all()


def test_pose_solver_gives_up_on_points_that_hold_no_pose():
    _, measured = scene(np.random.default_rng(0))
    one_point = changed(measured, points_local=np.zeros((200, 3)), uv_px=np.full((200, 2), 100.0))
    solver = PoseSolver(CAMERA, seed=0)
    coarse = solver.search(one_point)
    assert coarse is None or np.isfinite(coarse.T_local_base).all()
    assert solver.refine(one_point, se3.identity()) is None


def test_slopes_of_a_pose_are_its_residuals_differences():
    T_local_base, measured = scene(np.random.default_rng(0), count=20)
    errors = PoseErrors(CAMERA, measured.points_local, measured.seen)
    T_cam_local = se3.inverse(T_local_base @ CAMERA.T_base_cam)
    errors.move(T_cam_local)
    rows = errors.rows(np.ones((3, 1))).copy()
    assert np.abs(rows[6]).max() < 1e-9
    for axis, twist in enumerate(1e-6 * np.eye(6)):
        sides = []
        for sign in (1.0, -1.0):
            # A twist of the camera is the inverse one of what it sees.
            errors.move(se3.exp(-sign * twist) @ T_cam_local)
            sides.append(errors.residuals)
        slope = (sides[0] - sides[1]) / 2e-6
        assert np.abs(rows[axis] - slope).max() < 1e-3
