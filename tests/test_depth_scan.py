"""Scans made of depth images of walls, boxes and floors whose distance is known."""

from dataclasses import replace

import numpy as np
import pytest

from sceneslam.scans.depth_scan import DepthScanner, scan_frame
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Camera, optical_to_rep103


def camera_at(height_m=0.0, tilt_rad=0.0, yaw_rad=0.0, x_m=0.0, y_m=0.0):
    """Return a Kinect-like camera; a positive tilt looks down."""
    turn = se3.from_xy_yaw(x_m, y_m, yaw_rad)
    turn[2, 3] = height_m
    turn[:3, :3] = turn[:3, :3] @ se3.so3_exp(np.array([0.0, tilt_rad, 0.0]))
    return Camera(
        size_wh=(640, 480),
        fx=525.0,
        fy=525.0,
        cx=319.5,
        cy=239.5,
        depth_range_m=(0.4, 6.0),
        T_base_cam=turn @ optical_to_rep103(),
    )


def rays_base(camera):
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], 2)
    return rays @ camera.T_base_cam[:3, :3].T


def depth_of_wall(camera, x_m):
    """Return the depth of the plane x = x_m in base."""
    depth = (x_m - camera.T_base_cam[0, 3]) / rays_base(camera)[..., 0]
    return np.where(depth > 0, depth, 0).astype(np.float32)


def depth_of_floor(camera):
    with np.errstate(divide="ignore"):
        depth = -camera.T_base_cam[2, 3] / rays_base(camera)[..., 2]
    return np.where((depth > 0) & (depth < 50), depth, 0).astype(np.float32)


def scan_from_depth(depth_m, camera, *, stamp_ns, **band):
    return DepthScanner(camera, beams=180, stride_px=2, **band).scan(depth_m, stamp_ns=stamp_ns)


def points_base(scan, T_base_laser):
    held = np.isfinite(scan.ranges_m)
    angles, ranges = scan.angles_rad[held], scan.ranges_m[held]
    points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), 0 * ranges], axis=1)
    return se3.apply(T_base_laser, points.astype(float))


@pytest.mark.parametrize("height_m", [0.0, 0.4, 1.2])
@pytest.mark.parametrize("tilt_rad", [0.0, 0.15, -0.2])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.3])
def test_wall_is_at_its_distance_for_any_height_tilt_and_yaw(height_m, tilt_rad, yaw_rad):
    camera = camera_at(height_m, tilt_rad, yaw_rad, x_m=0.1, y_m=-0.05)
    scan = scan_from_depth(depth_of_wall(camera, 2.5), camera, stamp_ns=7)
    points = points_base(scan, scan_frame(camera))
    assert scan.stamp_ns == 7
    assert len(points) >= 170
    np.testing.assert_allclose(points[:, 0], 2.5, atol=0.012)


def test_floor_is_no_obstacle_and_a_box_on_it_is():
    camera = camera_at(height_m=0.4, tilt_rad=0.1)
    depth = depth_of_floor(camera)
    scan = scan_from_depth(depth, camera, stamp_ns=0, height_min_m=0.05, height_max_m=0.6)
    assert np.isnan(scan.ranges_m).all()
    box = depth_of_wall(camera, 1.5)
    heights = 0.4 + rays_base(camera)[..., 2] * box
    columns = slice(300, 341)
    box_seen = (heights[:, columns] < 0.3) & (heights[:, columns] > 0)
    depth[:, columns][box_seen] = box[:, columns][box_seen]
    scan = scan_from_depth(depth, camera, stamp_ns=0, height_min_m=0.05, height_max_m=0.6)
    held = np.isfinite(scan.ranges_m)
    assert 8 <= held.sum() <= 16
    np.testing.assert_allclose(points_base(scan, scan_frame(camera))[:, 0], 1.5, atol=0.01)


def test_nearest_of_two_upright_surfaces_in_one_column_wins():
    camera = camera_at()
    depth = depth_of_wall(camera, 3.0)
    depth[210:270] = 1.0  # 0.11 m high
    scan = scan_from_depth(depth, camera, stamp_ns=0)
    assert np.nanmax(np.abs(scan.ranges_m * np.cos(scan.angles_rad) - 1.0)) < 0.005


def test_edge_of_a_board_is_overlooked_from_near_and_far():
    camera = camera_at()
    for board_m, rows in ((0.6, slice(250, 276)), (2.0, slice(243, 251))):  # 0.03 m high
        depth = depth_of_wall(camera, board_m + 0.3)
        depth[rows] = board_m
        scan = scan_from_depth(depth, camera, stamp_ns=0)
        np.testing.assert_allclose(
            scan.ranges_m * np.cos(scan.angles_rad), board_m + 0.3, atol=0.005
        )


def test_noise_does_not_shorten_the_range():
    camera = camera_at()
    rng = np.random.default_rng(3)
    noise = rng.normal(0, 0.0012 + 0.0019 * 2.6**2, (480, 640)).astype(np.float32)
    scan = scan_from_depth(depth_of_wall(camera, 3.0) + noise, camera, stamp_ns=0)
    assert abs(np.nanmean(scan.ranges_m * np.cos(scan.angles_rad)) - 3.0) < 0.01


def test_wall_at_the_limit_of_depth_is_not_seen_rather_than_seen_too_near():
    camera, rng = camera_at(), np.random.default_rng(0)

    def scan_of(distance_m):
        depth = depth_of_wall(camera, distance_m)
        depth += rng.normal(0.0, 0.05, depth.shape).astype(np.float32)
        depth[depth > 6.0] = 0.0
        return scan_from_depth(depth, camera, stamp_ns=0)

    assert np.isnan(scan_of(5.98).ranges_m).all()  # 4 cm too near when it is
    scan = scan_of(5.8)
    assert abs(np.mean(scan.ranges_m * np.cos(scan.angles_rad)) - 5.8) < 0.005


@pytest.mark.parametrize("limit_m", [1000.0, np.inf])
def test_limit_far_beyond_what_a_camera_sees_hides_nothing(limit_m):
    camera = replace(camera_at(), depth_range_m=(0.4, limit_m))
    assert np.isfinite(
        scan_from_depth(depth_of_wall(camera, 5.0), camera, stamp_ns=0).ranges_m
    ).all()


def test_missing_and_broken_depth_gives_beams_without_measurement():
    camera = replace(camera_at(), depth_range_m=(0.0, 6.0))
    for value in (0.0, np.nan, np.inf, -np.inf, -1.0, 100.0):
        depth = np.full((480, 640), value, np.float32)
        assert np.isnan(scan_from_depth(depth, camera, stamp_ns=0).ranges_m).all()


def test_lens_distortion_is_taken_out():
    straight = camera_at()
    bent = Camera(
        size_wh=(640, 480),
        fx=525.0,
        fy=525.0,
        cx=319.5,
        cy=239.5,
        distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
        depth_range_m=(0.4, 6.0),
    )
    depth = np.full((480, 640), 2.0, np.float32)
    ends = [
        np.abs(scan_from_depth(depth, camera, stamp_ns=0).angles_rad).max()
        for camera in (straight, bent)
    ]
    assert 0.002 < abs(ends[0] - ends[1]) < 0.05


def test_pixels_that_no_ray_of_a_folding_lens_reaches_have_no_beam():
    camera = Camera(
        size_wh=(640, 480),
        fx=300.0,
        fy=300.0,
        cx=319.5,
        cy=239.5,
        distortion=(-0.33, 0.12, 0.0, 0.0, -0.02),
        depth_range_m=(0.4, 6.0),
    )
    scan = scan_from_depth(np.full((480, 640), 2.0, np.float32), camera, stamp_ns=0)
    assert 0.8 < np.abs(scan.angles_rad).max() < np.arctan(1.64)  # it folds at 1.62


def test_camera_that_looks_straight_down_has_a_frame():
    camera = camera_at(height_m=1.0, tilt_rad=np.pi / 2)
    assert abs(se3.yaw_rad(scan_frame(camera))) < 1e-6


def test_wrong_arguments_are_named():
    camera = camera_at()
    with pytest.raises(ConfigError, match="height_max_m"):
        DepthScanner(camera, height_min_m=1.0, height_max_m=0.5, beams=90, stride_px=2)
    with pytest.raises(ConfigError, match="beams"):
        DepthScanner(camera, beams=1, stride_px=2)
    with pytest.raises(ConfigError, match="stride_px"):
        DepthScanner(camera, beams=90, stride_px=0)
    with pytest.raises(ConfigError, match="height_min_m"):
        DepthScanner(camera, height_min_m=50.0, height_max_m=60.0, beams=90, stride_px=2)
    with pytest.raises(InputError, match=r"expected \(480, 640\), got \(240, 320\)"):
        scan_from_depth(np.zeros((240, 320), np.float32), camera, stamp_ns=0)
