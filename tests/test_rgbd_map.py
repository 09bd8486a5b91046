"""What the rgbd module keeps: features, landmarks, keyframes, motion, layers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rgbd_features import AT_REST, empty_map, features_at, random_descriptors, settings_with

from sceneslam.modules.slam.rgbd.adjust.fusion import fuse_duplicates
from sceneslam.modules.slam.rgbd.locate import recognition
from sceneslam.modules.slam.rgbd.locate.localizer import VisualLocalizer
from sceneslam.modules.slam.rgbd.locate.pose_solver import PoseSolver
from sceneslam.modules.slam.rgbd.map.keyframes import DepthView, Keyframe, KeyframeStore
from sceneslam.modules.slam.rgbd.map.landmarks import LandmarkTable, Looks
from sceneslam.modules.slam.rgbd.map.layers import LayerBuilder
from sceneslam.modules.slam.rgbd.see.alignment import Alignment
from sceneslam.modules.slam.rgbd.see.features import FeatureExtractor
from sceneslam.modules.slam.rgbd.see.lens import undistorted, undistorted_bounds
from sceneslam.types import se3
from sceneslam.types.rig import Camera

CAMERA = Camera(size_wh=(640, 480), fx=525.0, fy=520.0, cx=319.0, cy=241.0)
FIVE_HUNDRED = settings_with(feature_count=500)


def looks(count):
    return Looks(
        descriptors=np.zeros((count, 32), np.uint8),
        normals_local=np.zeros((count, 3)),
        reach_m=np.ones(count),
    )


def test_landmarks_fuse_by_inverse_variance_and_reuse_rows():
    table = LandmarkTable()
    eye = np.eye(3)[None]
    ids = table.add(points_local=np.zeros((1, 3)), information=eye, looks=looks(1))
    table.fuse(ids, points_local=np.ones((1, 3)), information=3 * eye)
    assert table.points_local[ids] == pytest.approx(0.75 * np.ones((1, 3)))
    assert table.covariance[ids] == pytest.approx(0.25 * eye)
    table.shift(ids, np.ones((1, 3)))
    table.remove(ids)
    many = np.repeat(eye, 10_000, axis=0)
    ids = table.add(points_local=np.zeros((10_000, 3)), information=many, looks=looks(10_000))
    assert ids.tolist() == list(range(10_000))
    assert len(table) == 10_000
    assert not table.shift_local.any()


def keyframe_at(x_m, landmark_ids=(), count=60, camera=CAMERA):
    rng = np.random.default_rng(int(1000 * x_m))
    ids = np.full(count, -1)
    ids[: len(landmark_ids)] = landmark_ids
    return Keyframe(
        stamp_ns=0,
        T_local_base=se3.from_xy_yaw(x_m, 0, 0),
        features=features_at(
            rng.uniform([0, 0], camera.size_wh, (count, 2)),
            random_descriptors(rng, count),
            depth_m=np.full(count, 2.0),
        ),
        landmark_ids=ids,
        view=DepthView(
            points_base=np.zeros((0, 3), np.float32),
            colors_bgr=np.zeros((0, 3), np.uint8),
            pixels=0,
            scan=None,
        ),
        turning=AT_REST,
    )


def test_covisible_keyframes_are_ranked_by_shared_landmarks():
    store = KeyframeStore()
    first = store.insert(keyframe_at(0, [1, 2, 3]))
    second = store.insert(keyframe_at(1, [3, 4]))
    store.insert(keyframe_at(2, [9]))
    assert store.covisible(np.array([2, 3, -1]), limit=5) == [first, second]
    store.forget_landmarks(np.array([2, 3]))
    assert store.landmarks_of([first, second]).tolist() == [1, 4]


def test_map_stays_within_its_limits_and_forgets_only_redundant_keyframes():
    visual_map = empty_map(CAMERA, keyframe_limit=10, landmark_limit=100_000)
    for step in range(30):
        visual_map.insert(keyframe_at(0.1 * step), deep_rows=np.zeros(0, np.int64))
        visual_map.keep_limits()
    assert len(visual_map.keyframes) == 10
    assert len(visual_map.landmarks) == 10 * 60
    positions = [keyframe.T_local_base[0, 3] for keyframe in visual_map.keyframes.all()]
    assert positions[0] == 0.0
    assert positions[-1] == pytest.approx(2.9)
    assert max(np.diff(positions)) < 0.8


def test_corrected_keyframes_take_along_the_landmarks_that_they_saw_first():
    visual_map = empty_map(CAMERA)
    first, second = keyframe_at(0.5), keyframe_at(1.5)
    visual_map.insert(first, deep_rows=np.zeros(0, np.int64))
    second.landmark_ids[:20] = first.landmark_ids[:20]
    visual_map.insert(second, deep_rows=np.zeros(0, np.int64))
    table = visual_map.landmarks
    before = visual_map.predict(second.T_local_base, second.landmark_ids[20:])
    shared_m = table.points_local[second.landmark_ids[:20]]
    moved = second.T_local_base @ se3.exp(np.array([0.3, -0.1, 0.2, 0.1, 0.2, -0.3]))
    visual_map.correct({1: moved})
    assert second.T_local_base == pytest.approx(moved, abs=1e-15)
    assert (table.points_local[second.landmark_ids[:20]] == shared_m).all()
    after = visual_map.predict(moved, second.landmark_ids[20:])
    assert after.uv_px == pytest.approx(before.uv_px)
    assert (after.levels == before.levels).all()
    product = table.covariance[second.landmark_ids] @ table.information[second.landmark_ids]
    assert product == pytest.approx(np.repeat(np.eye(3)[None], 60, axis=0), abs=1e-6)


def test_rotations_stay_rotations_over_many_corrections():
    visual_map = empty_map(CAMERA)
    for step in range(2):
        visual_map.insert(keyframe_at(0.1 * step), deep_rows=np.zeros(0, np.int64))
    rng = np.random.default_rng(0)
    store = visual_map.keyframes
    for step in range(60):  # as after a local bundle adjustment: the newer moves with the older
        older, newer = step % 2, 1 - step % 2
        adjusted = store[older].T_local_base @ se3.exp(0.01 * rng.standard_normal(6))
        T_new_old = adjusted @ se3.inverse(store[older].T_local_base)
        visual_map.correct({older: adjusted, newer: T_new_old @ store[newer].T_local_base})
    rotation = store[1].T_local_base[:3, :3]
    assert rotation.T @ rotation == pytest.approx(np.eye(3), abs=1e-13)


def test_landmarks_are_predicted_where_they_were_seen():
    visual_map = empty_map(CAMERA)
    keyframe = keyframe_at(0.5)
    visual_map.insert(keyframe, deep_rows=np.zeros(0, np.int64))
    prediction = visual_map.predict(keyframe.T_local_base, keyframe.landmark_ids)
    assert prediction.uv_px == pytest.approx(keyframe.features.uv_px)
    assert (prediction.levels == keyframe.features.levels).all()
    behind = keyframe.T_local_base @ se3.from_xy_yaw(0, 0, np.pi)
    assert len(visual_map.predict(behind, keyframe.landmark_ids).ids) == 0


def patchwork(rng, fine_px=24, coarse_px=48):
    """Return a grey image whose left half has small patches, the right half large ones."""
    halves = [
        cv2.resize(
            rng.integers(0, 255, (480 // size, 320 // size), np.uint8),
            (320, 480),
            interpolation=cv2.INTER_NEAREST,
        )
        for size in (fine_px, coarse_px)
    ]
    return cv2.GaussianBlur(np.hstack(halves), (0, 0), 1)


def test_features_cover_more_of_the_image_than_the_strongest_corners():
    gray = patchwork(np.random.default_rng(0))
    extractor = FeatureExtractor(CAMERA, Alignment(), settings=FIVE_HUNDRED)
    spread = extractor.extract(gray, None).uv_px
    strongest = cv2.KeyPoint.convert(cv2.ORB.create(nfeatures=500).detect(gray, None))
    assert len(spread) == 500
    assert cells_covered(spread) > 1.5 * cells_covered(strongest)


def cells_covered(uv_px):
    return len(np.unique(uv_px // 40, axis=0))


def test_noise_and_black_give_few_features():
    rng = np.random.default_rng(0)
    extractor = FeatureExtractor(CAMERA, Alignment(), settings=FIVE_HUNDRED)
    noise = np.clip(rng.normal(20, 4, (480, 640)), 0, 255).astype(np.uint8)
    assert len(extractor.extract(noise, None)) < 150
    assert len(extractor.extract(np.zeros((480, 640), np.uint8), None)) == 0


@pytest.mark.parametrize("alignment", [Alignment(), Alignment(focal_ratio=0.9, baseline_m=0.02)])
def test_black_image_of_any_camera_has_no_features(alignment):
    camera = replace(CAMERA, distortion=(0.26, -0.95, -0.005, 0.003, 1.16))
    extractor = FeatureExtractor(camera, alignment, settings=FIVE_HUNDRED)
    features = extractor.extract(np.zeros((480, 640), np.uint8), np.ones((480, 640), np.float32))
    assert len(features) == 0
    assert features.descriptors.shape == (0, 32)


def test_depth_is_missing_at_depth_edges_and_where_it_is_not_a_number():
    extractor = FeatureExtractor(CAMERA, Alignment(), settings=FIVE_HUNDRED)
    gray = patchwork(np.random.default_rng(0), fine_px=16, coarse_px=16)
    depth_m = np.full((480, 640), 1.0, np.float32)
    depth_m[:, 320:] = 3.0
    depth_m[:100] = np.nan
    features = extractor.extract(gray, depth_m)
    u, v = np.rint(features.uv_px).T
    edge = (u >= 318) & (u <= 321)
    assert (features.depth_m[(v < 100) | edge] == 0).all()
    assert (features.depth_m[(v > 102) & (u < 317)] == 1.0).all()


def test_depth_is_missing_for_colours_that_another_camera_sees_outside_of_the_depth_image():
    alignment = Alignment(focal_ratio=0.7)
    extractor = FeatureExtractor(CAMERA, alignment, settings=FIVE_HUNDRED)
    gray = patchwork(np.random.default_rng(0))
    features = extractor.extract(gray, np.ones((480, 640), np.float32))
    centre = np.array([CAMERA.cx, CAMERA.cy])
    uv_depth = np.rint((features.uv_px - centre) / 0.7 + centre)
    inside = ((uv_depth >= 0) & (uv_depth < CAMERA.size_wh)).all(axis=1)
    assert 20 < inside.sum() < len(features) - 20
    np.testing.assert_array_equal(features.depth_m, np.where(inside, 1.0, 0.0))


BARREL = replace(CAMERA, distortion=(-0.3, 0.1, 0.002, -0.001, 0.0))


def depth_of_two_walls(T_base_other):
    """The depth [m] that a camera with distortion has of two slanted walls, from another pose."""
    v, u = np.mgrid[:480, :640].astype(float)
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)[:, None]
    rays = cv2.undistortPoints(pixels, BARREL.K, np.array(BARREL.distortion))[:, 0]
    T_other_cam = T_base_other @ BARREL.T_base_cam
    rays_base = np.column_stack([rays, np.ones(len(rays))]) @ T_other_cam[:3, :3].T
    normals = np.array([[0.7, 0.7, 0.0], [0.7, -0.7, 0.2]])
    depths_m = (2.0 - normals @ T_other_cam[:3, 3]) / (rays_base @ normals.T)
    return np.where(depths_m > 0, depths_m, np.inf).min(axis=1).reshape(480, 640).astype("f4")


@pytest.mark.parametrize("distortion", [BARREL.distortion, CAMERA.distortion])
def test_landmarks_are_expected_up_to_the_sides_of_a_distorted_image(distortion):
    camera = replace(CAMERA, distortion=distortion)
    sides = np.array([(1.0, 240.0), (639.0, 240.0), (320.0, 1.0), (320.0, 479.0)])
    sides_px, centre = undistorted(camera, sides), np.array([CAMERA.cx, CAMERA.cy])
    keyframe = keyframe_at(0, count=8, camera=camera)
    keyframe.features.uv_px[:] = np.concatenate([sides_px, 1.05 * (sides_px - centre) + centre])
    visual_map = empty_map(camera)
    visual_map.insert(keyframe, deep_rows=np.zeros(0, np.int64))
    expected = visual_map.predict(keyframe.T_local_base, keyframe.landmark_ids)
    assert expected.ids.tolist() == keyframe.landmark_ids[:4].tolist()


def test_points_of_a_camera_with_distortion_lie_on_the_walls():
    layers = LayerBuilder(BARREL, settings_with())
    image_bgr = np.zeros((480, 640, 3), np.uint8)
    points = layers.view(depth_of_two_walls(np.eye(4)), image_bgr, stamp_ns=0).points_base
    assert len(points) > 4000
    beyond_m = (points @ np.array([[0.7, 0.7, 0.0], [0.7, -0.7, 0.2]]).T).max(axis=1) - 2.0
    assert np.abs(beyond_m).max() < 0.003


FOLDED = replace(CAMERA, fx=310.0, fy=310.0, distortion=(-0.33, 0.12, 0.0, 0.0, -0.02))


def test_pixels_that_no_ray_of_a_folding_lens_reaches_are_missing():
    """This lens shows nothing farther than 301 px from the centre of its image."""
    layers = LayerBuilder(FOLDED, settings_with())
    wall_m, image_bgr = np.full((480, 640), 2.0, np.float32), np.zeros((480, 640, 3), np.uint8)
    points = layers.view(wall_m, image_bgr, stamp_ns=0).points_base
    assert 0.75 * 4800 < len(points) < 4800
    assert np.linalg.norm(points[:, 1:], axis=1).max() < 2.0 * 1.64  # it folds at 1.62
    extractor = FeatureExtractor(FOLDED, Alignment(), settings=FIVE_HUNDRED)
    features = extractor.extract(patchwork(np.random.default_rng(0)), wall_m)
    assert 300 < len(features) < 500
    assert len(features.descriptors) == len(features.levels) == len(features.depth_m)
    least_px, most_px = undistorted_bounds(FOLDED)
    assert (np.abs([least_px[0], most_px[0] - 640]) < 200).all() and (least_px < -40).all()
    assert (features.uv_px > least_px - 50).all() and (features.uv_px < most_px + 50).all()


def test_surfaces_agree_from_another_pose_of_a_camera_with_distortion(monkeypatch):
    monkeypatch.setattr(recognition, "_SURFACE_SLACK_M", 0.01)
    monkeypatch.setattr(recognition, "_SURFACE_SIGMAS", 0.0)
    layers = LayerBuilder(BARREL, settings_with())
    keyframe, image_bgr = keyframe_at(0, camera=BARREL), np.zeros((480, 640, 3), np.uint8)
    keyframe.view = layers.view(depth_of_two_walls(np.eye(4)), image_bgr, stamp_ns=0)
    recognizer = recognition.PlaceRecognizer(empty_map(BARREL), None, min_inliers=20)
    for T_local_base in (np.eye(4), se3.from_xy_yaw(0.3, 0.2, 0.3)):
        depth_m = depth_of_two_walls(T_local_base)
        assert recognizer._shows(keyframe, T_local_base, depth_m)
        assert not recognizer._shows(keyframe, T_local_base, 0.98 * depth_m)


@pytest.mark.parametrize("stride_px", [1, 8, 64, 100])
def test_surfaces_are_compared_with_any_stride_of_the_cloud(stride_px):
    layers = LayerBuilder(CAMERA, settings_with(cloud_stride_px=stride_px))
    wall_m, image_bgr = np.full((480, 640), 2.0, np.float32), np.zeros((480, 640, 3), np.uint8)
    keyframe = keyframe_at(0)
    keyframe.view = layers.view(wall_m, image_bgr, stamp_ns=0)
    recognizer = recognition.PlaceRecognizer(empty_map(CAMERA), None, min_inliers=20)
    beside = se3.from_xy_yaw(0.0, 0.4, 0.0)
    assert recognizer._shows(keyframe, beside, wall_m)
    assert not recognizer._shows(keyframe, beside, 1.5 * wall_m)
    sliver_m = np.where(np.arange(640) < 8, wall_m, np.float32(0.0))
    assert not recognizer._shows(keyframe, se3.identity(), sliver_m)


def test_a_few_points_in_sparse_depth_show_no_place():
    """Of 4800 pixels that the cloud takes, 30 have depth."""
    layers = LayerBuilder(CAMERA, settings_with())
    sparse_m = np.zeros((480, 640), np.float32)
    sparse_m[4:44:8, 4:52:8] = 2.0
    keyframe = keyframe_at(0)
    keyframe.view = layers.view(sparse_m, np.zeros((480, 640, 3), np.uint8), stamp_ns=0)
    assert len(keyframe.view.points_base) == 30
    recognizer = recognition.PlaceRecognizer(empty_map(CAMERA), None, min_inliers=20)
    wall_m = np.full((480, 640), 2.0, np.float32)
    assert not recognizer._shows(keyframe, se3.identity(), wall_m)


@pytest.mark.parametrize(("height_m", "has_scans"), [(0.0, True), (0.5, False)])
def test_only_a_robot_in_the_plane_gives_scans(height_m, has_scans):
    layers = LayerBuilder(CAMERA, settings_with())
    wall_m, image_bgr = np.full((480, 640), 2.0, np.float32), np.zeros((480, 640, 3), np.uint8)
    keyframe = keyframe_at(0)
    keyframe.T_local_base[2, 3] = height_m
    keyframe.view = layers.view(wall_m, image_bgr, stamp_ns=0)
    built = layers.build([keyframe])
    assert (built.scans is not None) == has_scans
    assert built.points.points[:, 0] == pytest.approx(2.0)
    assert layers.build([]).points is None


def test_nearest_keyframe_can_be_asked_for_among_the_old_ones_alone():
    store = KeyframeStore()
    for x_m in (0.0, 1.0, 2.0):
        store.insert(keyframe_at(x_m))
    here = se3.from_xy_yaw(2.0, 0.0, 0.0)
    assert store.nearest(here, per_m=1.0, per_rad=1.0) == 0.0
    assert store.nearest(here, per_m=1.0, per_rad=1.0, but_latest=1) == pytest.approx(1.0)
    for but_latest in (3, 4, 5, 20):
        assert store.nearest(here, per_m=1.0, per_rad=1.0, but_latest=but_latest) == np.inf


@pytest.mark.parametrize(("shown", "is_found"), [(40, False), (120, True)])
def test_a_pose_is_told_only_where_a_tenth_of_what_should_show_is_found(shown, is_found):
    visual_map = empty_map(CAMERA, keyframe_limit=10, landmark_limit=5000)
    mapped = keyframe_at(0, count=800)
    visual_map.insert(mapped, deep_rows=np.zeros(0, np.int64))
    rng = np.random.default_rng(1)
    uv_px = mapped.features.uv_px.copy()
    uv_px[shown:] = rng.uniform([0, 0], CAMERA.size_wh, (800 - shown, 2))
    descriptors = random_descriptors(rng, 800)
    descriptors[:shown] = mapped.features.descriptors[:shown]
    features = features_at(uv_px, descriptors, depth_m=np.full(800, 2.0))
    localizer = VisualLocalizer(visual_map, PoseSolver(CAMERA, seed=0), settings=settings_with())
    ids = visual_map.keyframes.landmarks_of([0])
    fix = localizer.near(features, se3.identity(), ids)
    assert (fix is not None) == is_found


def test_joining_two_sides_of_a_loop_leaves_no_keyframe_with_a_landmark_twice():
    """A keyframe shows 30 of 60 corners as the old side does, and beside them all copies."""
    visual_map, rng = empty_map(CAMERA, keyframe_limit=99), np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (60, 2)), np.full(60, 3.0)])
    descriptors, nothing = random_descriptors(rng, 60), np.full(60, -1)

    def seen(x_m, off_px=0.0):
        T_local_cam = se3.from_xy_yaw(x_m, 0.0, 0.0) @ CAMERA.T_base_cam
        ahead = se3.apply(se3.inverse(T_local_cam), se3.apply(CAMERA.T_base_cam, points))
        scale = [CAMERA.fx, CAMERA.fy] / ahead[:, 2:]
        return ahead[:, :2] * scale + [CAMERA.cx, CAMERA.cy] + off_px, ahead[:, 2]

    def insert(x_m, seen_px, landmark_ids):
        T_local_base = se3.from_xy_yaw(x_m, 0.0, 0.0)
        uv_px, depth_m = seen_px
        alike = np.tile(descriptors, (len(uv_px) // 60, 1))
        features = features_at(uv_px, alike, depth_m=depth_m)
        ids = np.array(landmark_ids)
        mapped = replace(keyframe_at(0.0), T_local_base=T_local_base, features=features)
        mapped = replace(mapped, landmark_ids=ids)
        return visual_map.insert(mapped, deep_rows=np.zeros(0, np.int64))

    old = insert(0.0, seen(0.0), nothing)
    ids_old = visual_map.keyframes[old].landmark_ids.copy()
    for _ in range(10):  # more of the old side than are looked at
        insert(0.0, seen(0.0), ids_old)
    new = insert(0.1, seen(0.1), nothing)
    ids_new = visual_map.keyframes[new].landmark_ids.copy()
    kept = ids_old.copy()
    visual_map.landmarks.scale_sigma[[*ids_old, *ids_new]] = 0.1  # by wheels, not by depth
    ids_both = [*np.where(np.arange(60) < 30, ids_old, -1), *ids_new]
    twice = [np.concatenate(parts) for parts in zip(seen(0.05), seen(0.05, 2.0), strict=True)]
    both = insert(0.05, twice, ids_both)
    fuse_duplicates(visual_map, old=old, new=new)
    for k in (old, new, both):
        shown = visual_map.keyframes[k].landmark_ids
        shown = shown[shown >= 0]
        assert len(shown) == len(np.unique(shown))
    assert visual_map.landmarks.scale_sigma[kept].tolist() == [0.1] * 60
