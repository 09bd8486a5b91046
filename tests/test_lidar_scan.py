"""Slices of a lidar's cloud whose walls are known."""

import numpy as np
import pytest

from sceneslam.scans.lidar_scan import LidarScanner
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.rig import Lidar


def scanner_at(T_base_lidar, **band):
    lidar = Lidar(range_m=(1.0, 60.0), T_base_lidar=T_base_lidar)
    return LidarScanner(lidar, **{"beams": 360, **band})


def room_lidar(T_base_lidar):
    """Return a square room of 10 m, walls from the floor up to 4 m, as the lidar sees it."""
    along, height = (
        part.ravel() for part in np.meshgrid(np.arange(-5, 5, 0.02), np.arange(0, 4, 0.1))
    )
    wall = np.full_like(along, 5.0)
    points_base = np.concatenate(
        [
            np.column_stack(parts)
            for parts in (
                (wall, along, height),
                (-wall, along, height),
                (along, wall, height),
                (along, -wall, height),
            )
        ]
    )
    return se3.apply(se3.inverse(T_base_lidar), points_base).astype(np.float32)


def tilted():
    T_base_lidar = se3.from_xy_yaw(0.4, -0.2, 0.5)
    T_base_lidar[2, 3] = 1.7
    T_base_lidar[:3, :3] = T_base_lidar[:3, :3] @ se3.so3_exp(np.array([0.03, 0.1, 0.0]))
    return T_base_lidar


def test_slice_of_a_tilted_lidar_lies_on_the_walls():
    T_base_lidar = tilted()
    scanner = scanner_at(T_base_lidar)
    scan = scanner.scan(room_lidar(T_base_lidar), stamp_ns=5)
    assert scan.stamp_ns == 5
    assert np.isfinite(scan.ranges_m).all()
    angles = scan.angles_rad
    points = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]) * scan.ranges_m[:, None]
    points_base = se3.apply(scanner.T_base_laser, points)
    np.testing.assert_allclose(np.abs(points_base[:, :2]).max(axis=1), 5.0, atol=0.06)


def test_what_is_below_the_band_or_too_near_is_not_seen():
    T_base_lidar = se3.identity()
    T_base_lidar[2, 3] = 1.7
    points = np.array([[3, 0, -1.0], [0.5, 0, 0], [0, 4, 0.1], [np.nan, 0, 0]], np.float32)
    scan = scanner_at(T_base_lidar).scan(points, stamp_ns=0)
    assert np.isfinite(scan.ranges_m).sum() == 1
    assert np.nanmin(scan.ranges_m) == pytest.approx(4.0)
    low = scanner_at(T_base_lidar, height_min_m=0.5, height_max_m=1.0).scan(points, stamp_ns=0)
    assert np.nanmin(low.ranges_m) == pytest.approx(3.0)


def test_the_nearest_return_of_a_beam_counts():
    points = np.array([[7, 0, 0], [3, 0, 0.05], [5, 0, 0]], np.float32)
    scan = scanner_at(se3.identity()).scan(points, stamp_ns=0)
    assert np.nanmin(scan.ranges_m) == pytest.approx(3.0)


def test_wrong_shapes_and_settings_are_named():
    with pytest.raises(InputError, match=r"expected \(N, 3\)"):
        scanner_at(se3.identity()).scan(np.zeros((4, 4), np.float32), stamp_ns=0)
    with pytest.raises(ConfigError, match="height_max_m"):
        scanner_at(se3.identity(), height_min_m=1.0, height_max_m=0.5)
    with pytest.raises(ConfigError, match="beams"):
        scanner_at(se3.identity(), beams=1)
