"""Corners without a measured depth, located by the motion between views."""

from dataclasses import replace

import numpy as np
import pytest
from test_views import CAMERA, MOUNT, place, points_of, view_of

from sceneslam.types import se3
from sceneslam.views.triangulation import Triangulation

S = 10**9
HERE = se3.from_xy_yaw(4.0, -2.0, 0.7)
WALL = place(1)  # 2 to 4 m ahead


START = se3.identity()


def blind(T_wall_base, *, seed=0):
    """The view of a camera without depth, from a pose before the wall."""
    view = view_of(WALL, T_wall_base, noise_px=0.0)
    noise = np.random.default_rng(seed).normal(0, 1.0 / CAMERA.fx, view.rays.shape)
    rays = (view.rays + noise).astype(np.float32)
    return replace(view, rays=rays, depth_m=np.zeros_like(view.depth_m))


def located(*before, here=START, seed=0):
    """What is located in a view from `here`, after views from about the poses `before`."""
    triangulation, rng = Triangulation(CAMERA), np.random.default_rng(seed)
    for index, T_wall_base in enumerate(before):
        off = se3.exp(rng.normal(0, np.repeat([0.01, 0.003], 3)))  # of the path
        view = blind(T_wall_base, seed=10 * seed + index + 1)
        triangulation.add(view, index * S, HERE @ T_wall_base @ off)
    return triangulation.locate(blind(here), HERE @ here)


def true_depths(T_wall_base):
    return se3.apply(se3.inverse(T_wall_base @ MOUNT), points_of(WALL))[:, 2]


@pytest.mark.parametrize("aside", [se3.from_xy_yaw(0.0, 0.4, 0.1), se3.from_xy_yaw(-1.0, 0.0, 0.0)])
def test_corners_are_where_the_rays_of_two_views_meet(aside):
    here, off, share = se3.exp(np.array([0.0, 0.0, 0.1, 0.02, -0.05, 0.1])), [], []
    for seed in range(20):
        found = located(aside, here=here, seed=seed)
        is_known = found.depth_m > 0
        share.append(is_known.mean())
        off += [(found.depth_m - true_depths(here))[is_known] / found.deviation_m[is_known]]
        assert (found.deviation_m <= 0.4 * found.depth_m).all()
    assert np.mean(share) > 0.4
    assert 0.6 < np.sqrt(np.mean(np.concatenate(off) ** 2)) < 1.5


def test_a_wider_base_locates_better():
    narrow, wide = (located(se3.from_xy_yaw(0.0, y_m, 0.0)) for y_m in (0.25, 1.0))
    both = located(*(se3.from_xy_yaw(0.0, y_m, 0.0) for y_m in (1.0, 0.25)))
    in_all = (narrow.depth_m > 0) & (wide.depth_m > 0)
    assert in_all.sum() > 50
    assert (wide.deviation_m[in_all] < 0.5 * narrow.deviation_m[in_all]).all()
    np.testing.assert_array_equal(both.depth_m[in_all], wide.depth_m[in_all])


@pytest.mark.parametrize(
    "before",
    [
        [],
        [se3.from_xy_yaw(0.0, 0.1, 0.0)],  # too near: a turn
        [se3.from_xy_yaw(-4.0, 0.0, 0.0)],  # so far that the path has drifted
    ],
)
def test_views_from_the_same_place_or_from_afar_locate_nothing(before):
    assert not located(*before).depth_m.any()


@pytest.mark.parametrize(("noise_m", "is_located"), [(0.014, True), (0.1, False)])
def test_noise_of_poses_is_no_jump_however_often_images_come(noise_m, is_located):
    triangulation, aside = Triangulation(CAMERA), se3.from_xy_yaw(0.0, 0.5, 0.0)
    for index in range(91):
        at_m = 0.5 - 0.5 * index / 90 + noise_m * (index % 4 == 1)
        stamp_ns = round(index * S / 90)
        triangulation.step(stamp_ns, HERE @ se3.from_xy_yaw(0.0, at_m, 0.0))
        if index == 0:
            triangulation.add(blind(aside), stamp_ns, HERE @ aside)
    assert triangulation.locate(blind(START), HERE).depth_m.any() == is_located


def test_what_looks_alike_elsewhere_is_not_located():
    """Corners with the descriptors of others: their rays do not meet."""
    aside = se3.from_xy_yaw(0.0, 0.5, 0.0)
    other = blind(aside)
    mixed = replace(other, rays=np.roll(other.rays, 1, axis=0))
    triangulation = Triangulation(CAMERA)
    triangulation.add(mixed, 0, HERE @ aside)
    found = triangulation.locate(blind(START), HERE)
    assert (found.depth_m > 0).mean() < 0.05


def test_measured_depths_stay_and_views_from_a_stamp_on_are_forgotten():
    aside, view = se3.from_xy_yaw(0.0, 0.5, 0.0), blind(START)
    seen = replace(view, depth_m=np.where(np.arange(len(view.depth_m)) < 50, 3.0, 0.0))
    triangulation = Triangulation(CAMERA)
    triangulation.add(blind(aside), 5 * S, HERE @ aside)
    assert not triangulation.locate(seen, HERE).depth_m[:50].any()
    triangulation.rewind(6 * S)
    assert triangulation.locate(seen, HERE).depth_m[50:].any()
    triangulation.rewind(5 * S)
    assert not triangulation.locate(seen, HERE).depth_m.any()
