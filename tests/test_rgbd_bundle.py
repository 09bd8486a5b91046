"""How the rgbd module adjusts keyframes and landmarks together, beside the tracking."""

from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rgbd_features import AT_REST, empty_map, features_at, random_descriptors

from sceneslam.modules.slam.rgbd.adjust.bundle import Bundle, adjust
from sceneslam.modules.slam.rgbd.adjust.fusion import join_duplicates
from sceneslam.modules.slam.rgbd.adjust.local_mapping import LocalMapping
from sceneslam.modules.slam.rgbd.adjust.mapping_work import MappingWork
from sceneslam.modules.slam.rgbd.adjust.pose_constraints import PoseConstraint, PoseConstraints
from sceneslam.modules.slam.rgbd.locate.residuals import Sightings, errors
from sceneslam.modules.slam.rgbd.map.keyframes import NO_LANDMARK, DepthView, Keyframe
from sceneslam.modules.slam.rgbd.see.alignment import Alignment
from sceneslam.types import se3
from sceneslam.types.rig import Camera

CAMERA = Camera(size_wh=(640, 480), fx=525.0, fy=520.0, cx=319.0, cy=241.0)
KEYFRAMES, LANDMARKS = 5, 200


def true_poses():
    steps = np.linspace(0.0, 1.0, KEYFRAMES)
    return np.stack([se3.exp(s * np.array([0.4, 0.1, 0.2, 0.05, -0.1, 0.1])) for s in steps])


def pixels(T_local_cam, points_local):
    points_cam = se3.apply(se3.inverse(T_local_cam), points_local)
    uv_px = points_cam[:, :2] / points_cam[:, 2:] * [CAMERA.fx, CAMERA.fy]
    return uv_px + np.array([CAMERA.cx, CAMERA.cy]), points_cam[:, 2]


def exact_bundle(rng, *, has_depth=True):
    """Return a bundle in which everything agrees; the first keyframe holds it."""
    points = rng.uniform([-1.5, -1.0, 1.5], [1.5, 1.0, 4.0], (LANDMARKS, 3))
    poses = true_poses()
    seen = [pixels(T, points) for T in poses]
    count = KEYFRAMES * LANDMARKS
    depth_m = np.concatenate([z for _, z in seen])
    return Bundle(
        T_local_cam=poses,
        is_free=np.arange(KEYFRAMES) > 0,
        points_local=points,
        keyframe_rows=np.repeat(np.arange(KEYFRAMES), LANDMARKS),
        landmark_rows=np.tile(np.arange(LANDMARKS), KEYFRAMES),
        seen=Sightings(
            uv_px=np.concatenate([uv for uv, _ in seen]),
            sigma_px=np.ones(count),
            depth_m=depth_m if has_depth else np.zeros(count),
            inverse_depth_sigma_per_m=np.full(count, 0.003),
        ),
        constraints=PoseConstraints.of([]),
    )


def disturbed(bundle, rng):
    poses = bundle.T_local_cam.copy()
    for row in np.flatnonzero(bundle.is_free):
        poses[row] = poses[row] @ se3.exp(rng.normal(0, 0.02, 6))
    points = bundle.points_local + rng.normal(0, 0.03, bundle.points_local.shape)
    return replace(bundle, T_local_cam=poses, points_local=points)


def test_disturbed_bundle_is_put_right_and_its_held_keyframe_stays():
    rng = np.random.default_rng(0)
    exact = exact_bundle(rng)
    adjusted = adjust(CAMERA, disturbed(exact, rng))
    assert adjusted.agrees.all()
    assert (adjusted.bundle.T_local_cam[0] == exact.T_local_cam[0]).all()
    assert adjusted.bundle.T_local_cam == pytest.approx(exact.T_local_cam, abs=1e-3)
    assert adjusted.bundle.points_local == pytest.approx(exact.points_local, abs=5e-3)


def test_a_constraint_moves_a_keyframe_that_has_hardly_any_other():
    rng = np.random.default_rng(6)
    exact = exact_bundle(rng)
    vague = replace(exact.seen, sigma_px=np.full(len(exact.keyframe_rows), 50.0))
    off = se3.exp(np.array([0.02, -0.01, 0.01, 0.01, 0.0, -0.01]))
    T_tied = se3.inverse(exact.T_local_cam[0]) @ exact.T_local_cam[4] @ off
    constraint = PoseConstraint(T_one_other=T_tied, root=1e4 * np.eye(6))
    adjusted = adjust(
        CAMERA, replace(exact, seen=vague, constraints=PoseConstraints.of([((0, 4), constraint)]))
    )
    T_found = se3.inverse(adjusted.bundle.T_local_cam[0]) @ adjusted.bundle.T_local_cam[4]
    assert pytest.approx(T_tied, abs=1e-3) == T_found


def test_wrong_sightings_are_named_and_do_no_harm():
    rng = np.random.default_rng(1)
    exact = exact_bundle(rng)
    uv_px = exact.seen.uv_px + rng.normal(0, 0.3, exact.seen.uv_px.shape)
    wrong = rng.random(len(uv_px)) < 0.1
    uv_px[wrong] += rng.choice([-40.0, 40.0], (int(wrong.sum()), 2))
    noisy = replace(exact, seen=replace(exact.seen, uv_px=uv_px))
    adjusted = adjust(CAMERA, disturbed(noisy, rng))
    assert not adjusted.agrees[wrong].any()
    assert adjusted.agrees[~wrong].mean() > 0.97
    assert adjusted.bundle.T_local_cam == pytest.approx(exact.T_local_cam, abs=4e-3)


def test_slopes_of_the_errors_are_their_differences():
    rng = np.random.default_rng(2)
    bundle = exact_bundle(rng)
    seen = Sightings(
        uv_px=bundle.seen.uv_px[:20] + 3.0,
        sigma_px=rng.uniform(1, 3, 20),
        depth_m=bundle.seen.depth_m[:20] * 1.02,
        inverse_depth_sigma_per_m=np.full(20, 0.003),
    )
    points_cam, tiny_m = bundle.points_local[:20].T, 1e-6
    for axis in range(3):
        step = np.zeros((3, 1))
        step[axis] = tiny_m
        above, below = (errors(CAMERA, points_cam + sign * step, seen).of for sign in (1, -1))
        slope = errors(CAMERA, points_cam, seen).by_point[:, axis]
        assert (above - below) / (2 * tiny_m) == pytest.approx(slope, rel=1e-4, abs=1e-4)


def keyframe_at(T_local_cam, points_local, descriptors, landmark_ids):
    uv_px, depth_m = pixels(T_local_cam, points_local)
    return Keyframe(
        stamp_ns=0,
        T_local_base=T_local_cam @ se3.inverse(CAMERA.T_base_cam),
        features=features_at(uv_px, descriptors, depth_m=depth_m),
        landmark_ids=landmark_ids,
        view=DepthView(
            points_base=np.zeros((0, 3), np.float32),
            colors_bgr=np.zeros((0, 3), np.uint8),
            pixels=0,
            scan=None,
        ),
        turning=AT_REST,
    )


def mapped(rng, *, is_matched):
    """Return a map of one scene seen by all keyframes, which share landmarks or do not."""
    points = rng.uniform([-0.6, -0.4, 1.5], [0.6, 0.4, 3.0], (LANDMARKS, 3))
    descriptors = random_descriptors(rng, LANDMARKS)
    visual_map = empty_map(CAMERA)
    for T_local_cam in true_poses():
        ids = np.full(LANDMARKS, NO_LANDMARK)
        if is_matched and len(visual_map.keyframes):
            ids = visual_map.keyframes[0].landmark_ids.copy()
        keyframe = keyframe_at(T_local_cam, points, descriptors, ids)
        visual_map.insert(keyframe, deep_rows=np.zeros(0, np.int64))
    return visual_map, points


def test_landmarks_mapped_twice_become_one():
    visual_map, _ = mapped(np.random.default_rng(3), is_matched=False)
    assert len(visual_map.landmarks) == KEYFRAMES * LANDMARKS
    join_duplicates(visual_map, visual_map.keyframes[1], None)
    first, second = (visual_map.keyframes[k].landmark_ids for k in (0, 1))
    assert (first == second).mean() > 0.95
    assert len(visual_map.landmarks) <= (KEYFRAMES - 1) * LANDMARKS + 10


def test_merge_comes_at_a_fixed_image_and_moves_what_is_newer_along():
    rng = np.random.default_rng(4)
    visual_map, points = mapped(rng, is_matched=True)
    T_true = visual_map.keyframes[4].T_local_base
    slip = se3.exp(np.array([0.03, 0, 0, 0, 0, 0]))
    visual_map.keyframes[4].T_local_base = slip @ T_true
    mapping = LocalMapping(CAMERA, visual_map, alignment=Alignment(), is_repeatable=True)
    moved = [mapping.step() for _ in range(9)]  # begins at the fifth
    assert (np.stack(moved) == np.eye(4)).all()
    newer = keyframe_at(
        slip @ T_true @ CAMERA.T_base_cam,
        points,
        random_descriptors(rng, LANDMARKS),
        np.full(LANDMARKS, NO_LANDMARK),
    )
    visual_map.insert(newer, deep_rows=np.zeros(0, np.int64))
    T_new_old = mapping.step()
    mapping.shutdown()
    assert T_new_old == pytest.approx(se3.inverse(slip), abs=2e-3)
    assert visual_map.keyframes[4].T_local_base == pytest.approx(T_true, abs=2e-3)
    assert newer.T_local_base == pytest.approx(T_true, abs=2e-3)
    table = visual_map.landmarks
    shared = table.points_local[visual_map.keyframes[0].landmark_ids]
    assert np.abs(shared - points).max() < 0.02


def test_live_merge_is_put_off_until_the_worker_is_done(monkeypatch):
    visual_map, _ = mapped(np.random.default_rng(4), is_matched=True)
    T_true = visual_map.keyframes[4].T_local_base
    visual_map.keyframes[4].T_local_base = se3.exp(np.array([0.03, 0, 0, 0, 0, 0])) @ T_true
    mapping = LocalMapping(CAMERA, visual_map, alignment=Alignment(), is_repeatable=False)
    asked, outcome = [], Future()
    worker = SimpleNamespace(submit=lambda task: asked.append(task) or outcome, end=lambda: None)
    monkeypatch.setattr(mapping, "_process", lambda: worker)
    moved = [mapping.step() for _ in range(40)]  # it begins at the fifth
    assert (np.stack(moved) == np.eye(4)).all() and len(asked) == 1
    outcome.set_result(MappingWork(CAMERA, CAMERA, Alignment())(asked[0]))
    mapping.step()
    assert visual_map.keyframes[4].T_local_base == pytest.approx(T_true, abs=2e-3)


def test_keyframes_with_depth_give_the_worker_twice_the_images():
    visual_map, _ = mapped(np.random.default_rng(6), is_matched=True)
    visual_map.keyframes[4].T_local_base = se3.from_xy_yaw(0.03, 0.0, 0.0)
    mapping = LocalMapping(CAMERA, visual_map, alignment=Alignment(), is_repeatable=True)
    frame = np.full(CAMERA.size_wh[::-1], np.nan, np.float32)
    mapping.insert(4, SimpleNamespace(features=visual_map.keyframes[4].features, depth_m=frame))
    moved = [not np.array_equal(mapping.step(), np.eye(4)) for _ in range(15)]
    mapping.shutdown()
    assert [image + 1 for image, has_moved in enumerate(moved) if has_moved] == [15]


def test_map_that_was_corrected_meanwhile_stays_as_it_is():
    visual_map, _ = mapped(np.random.default_rng(5), is_matched=True)
    mapping = LocalMapping(CAMERA, visual_map, alignment=Alignment(), is_repeatable=True)
    for _ in range(5):
        mapping.step()
    corrected = se3.from_xy_yaw(1.0, 0.0, 0.1)
    visual_map.correct({k: corrected @ visual_map.keyframes[k].T_local_base for k in range(5)})
    before = visual_map.keyframes[4].T_local_base
    moved = [mapping.step() for _ in range(5)]
    assert (np.stack(moved) == np.eye(4)).all()
    assert (visual_map.keyframes[4].T_local_base == before).all()
    mapping.shutdown()
