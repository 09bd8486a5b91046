"""Alignment of colours and depth of two cameras, and constraints between keyframes by depth."""

from dataclasses import replace

import numpy as np
import pytest
from rgbd_features import features_at, random_descriptors
from test_rgbd_bundle import exact_bundle

from sceneslam.modules.slam.rgbd.adjust.mapping_work import MappingWork, Task
from sceneslam.modules.slam.rgbd.adjust.pose_constraints import DepthConstraints
from sceneslam.modules.slam.rgbd.see.alignment import Alignment
from sceneslam.modules.slam.rgbd.see.alignment_search import AlignmentSearch, Pair, Shown
from sceneslam.types import se3
from sceneslam.types.rig import Camera

CAMERA = Camera(size_wh=(640, 480), fx=585.0, fy=585.0, cx=320.0, cy=240.0)
RAW_KINECT = Alignment(focal_ratio=0.9, baseline_m=0.025)
# A corner of a room: normals and offsets [m] of its planes in the first camera.
NORMALS = np.array([[0.6, 0.0, 0.8], [-0.7, 0.1, 0.7], [0.0, 0.8, 0.6]])
OFFSETS_M = np.array([1.6, 1.7, 1.5])


def depth_image(T_local_cam):
    """Return the corner's depth [m] from a pose."""
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    along = rays @ (NORMALS @ T_local_cam[:3, :3]).T
    left = OFFSETS_M - NORMALS @ T_local_cam[:3, 3]
    depths_m = np.where(along > 1e-6, left / np.where(along > 1e-6, along, 1.0), np.inf)
    return depths_m.min(axis=-1).astype(np.float32)


def corners(rng, depth_m, count=300):
    """Return points (N, 3) of a depth image, in its camera."""
    u, v = rng.uniform(60, 580, count), rng.uniform(60, 420, count)
    z = depth_m[np.rint(v).astype(int), np.rint(u).astype(int)]
    x, y = (np.rint(u) - CAMERA.cx) / CAMERA.fx, (np.rint(v) - CAMERA.cy) / CAMERA.fy
    return np.column_stack([x * z, y * z, z])


def pixels(alignment, points_depth):
    camera = alignment.color_camera(CAMERA)
    points = points_depth - alignment.T_depth_color[:3, 3]
    return points[:, :2] / points[:, 2:] * camera.fx + np.array([camera.cx, camera.cy])


def motions(rng, count):
    return [se3.exp(rng.normal(0, [0.08, 0.08, 0.08, 0.06, 0.06, 0.06])) for _ in range(count)]


def search(alignment):
    rng = np.random.default_rng(0)
    one_depth_m = depth_image(np.eye(4))
    finder, found = AlignmentSearch(CAMERA, is_over=False), None
    for T_one_other in motions(rng, 9):
        points = corners(rng, one_depth_m)
        there = se3.apply(se3.inverse(T_one_other), points)
        pair = Pair(
            one_px=pixels(alignment, points) + rng.normal(0, 0.5, (len(points), 2)),
            other_px=pixels(alignment, there) + rng.normal(0, 0.5, (len(points), 2)),
            sigma_px=np.ones(len(points)),
            one_depth_m=one_depth_m,
            T_other_one=se3.inverse(T_one_other),
        )
        found = finder.add(pair) or found
    return found


@pytest.mark.parametrize("true", [RAW_KINECT, Alignment(focal_ratio=0.94, baseline_m=0.045)])
def test_colours_of_another_camera_are_found_wherever_that_camera_is(true):
    """The second camera is not where the search begins."""
    found = search(true)
    assert found is not None
    assert found.focal_ratio == pytest.approx(true.focal_ratio, abs=0.01)
    assert found.baseline_m == pytest.approx(true.baseline_m, abs=0.01)


@pytest.mark.parametrize("baseline_m", [0.0, 0.005])
def test_registered_colours_stay_registered(baseline_m):
    assert search(Alignment(focal_ratio=1.005, baseline_m=baseline_m)) is None


def test_depth_is_looked_up_where_the_other_camera_sees_the_same():
    depth_m = depth_image(np.eye(4))
    points = corners(np.random.default_rng(1), depth_m)
    uv_px, images = pixels(RAW_KINECT, points), np.zeros(len(points), int)
    found_px = RAW_KINECT.find(CAMERA, uv_px, depth_m[None], images)
    true_px = pixels(Alignment(), points)
    assert np.median(np.abs(found_px - true_px)) < 0.2
    assert np.median(np.abs(uv_px - true_px)) > 5.0


def test_a_depth_constraint_leaves_room_for_what_does_not_average_out():
    """Depths with a Kinect's noise per pixel (Khoshelham and Elberink, Sensors 2012).

    A whole image averages that out, and what is left (lens, calibration) is not in it: so a
    constraint claims about a seventieth of the information that the noise alone would let it have.
    """
    T_one_other = se3.exp(np.array([0.08, -0.05, 0.06, 0.03, -0.05, 0.04]))
    squares = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        constraints = DepthConstraints(CAMERA, np.eye(4))
        for number, T in enumerate((np.eye(4), T_one_other)):
            depth_m = depth_image(T)
            noise_m = 1.425e-3 * depth_m**2 * rng.normal(size=depth_m.shape)
            constraints.look(number, (depth_m + noise_m).astype(np.float32))
        found = constraints.between(0, 1, T_one_other)
        squares.append(
            np.sum((found.root @ se3.log(se3.inverse(T_one_other) @ found.T_one_other)) ** 2)
        )
    assert 1 / 140 < np.mean(squares) / 6 < 1 / 35


def test_surfaces_constrain_two_keyframes_where_they_truly_are():
    T_one_other = se3.exp(np.array([0.08, -0.05, 0.06, 0.03, -0.05, 0.04]))
    T_depth_cam = RAW_KINECT.T_depth_color
    constraints = DepthConstraints(CAMERA, T_depth_cam)
    constraints.look(0, depth_image(np.eye(4)))
    constraints.look(1, depth_image(T_one_other))
    T_true = se3.inverse(T_depth_cam) @ T_one_other @ T_depth_cam
    found = constraints.between(0, 1, T_true @ se3.exp(np.full(6, 0.02)))
    assert found is not None
    assert found.T_one_other == pytest.approx(T_true, abs=2e-3)
    assert constraints.between(0, 7, T_true) is None


def test_a_search_that_finds_nothing_does_not_keep_all_images():
    """Every fourth pixel has depth, as of a projected lidar: there are corners, but no surfaces."""
    work, rng = MappingWork(CAMERA, CAMERA, None), np.random.default_rng(0)
    bundle, depth_m = exact_bundle(rng), np.zeros(CAMERA.size_wh[::-1], np.float32)
    depth_m[::2, ::2] = 2.0
    features = features_at(rng.uniform(50, 400, (100, 2)), random_descriptors(rng, 100))
    for step in range(70):
        ids, shown = list(range(step, step + 5)), Shown(features=features, depth_m=depth_m)
        work(
            Task(
                bundle=bundle,
                keyframe_ids=ids,
                free_ids=ids[:0],
                map_ids=frozenset(ids),
                fresh={ids[-1]: shown},
                by_odometry=[],
            )
        )
    assert not work._search.is_over
    assert len(work._searched) == 60  # those that can still be registered


def test_constraints_of_keyframes_that_left_the_map_are_forgotten():
    rng = np.random.default_rng(0)
    work, bundle = MappingWork(CAMERA, CAMERA, Alignment()), exact_bundle(rng)
    bundle = replace(bundle, T_local_cam=np.repeat(bundle.T_local_cam[:1], 5, axis=0))
    shown = Shown(
        features=features_at(np.zeros((1, 2)), random_descriptors(rng, 1)),
        depth_m=depth_image(np.eye(4)),
    )
    for ids in ([0, 1, 2, 3, 4], [0, 1, 3, 4, 5]):
        work(
            Task(
                bundle=bundle,
                keyframe_ids=ids,
                free_ids=ids[-3:],
                map_ids=frozenset(ids),
                fresh=dict.fromkeys(ids[-3:], shown),
                by_odometry=[],
            )
        )
    assert set(work._constraints) == {(3, 4), (3, 5), (4, 5)}
