"""Occupancy grids of rooms whose walls are known."""

import numpy as np
import pytest

from sceneslam.scans.occupancy_grid import OccupancyGrid, drawn, scan_layer, walls
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import LaserScan


def scan_of(ranges_m, fov_rad=2 * np.pi, range_max_m=20.0):
    ranges = np.asarray(ranges_m, np.float32)
    return LaserScan(
        stamp_ns=0,
        ranges_m=ranges,
        angle_min_rad=-fov_rad / 2,
        angle_step_rad=fov_rad / len(ranges),
        range_min_m=0.05,
        range_max_m=range_max_m,
    )


def value_at(layer, x_m, y_m):
    column = int(np.floor((x_m - layer.origin_xy_m[0]) / layer.resolution_m))
    row = int(np.floor((y_m - layer.origin_xy_m[1]) / layer.resolution_m))
    return layer.log_odds[row, column]


def test_circle_of_walls_is_free_inside_and_unknown_outside():
    grid = OccupancyGrid(0.05)
    grid.insert(se3.from_xy_yaw(1.0, -2.0, 0.7), scan_of(np.full(720, 3.0)))
    layer = grid.layer()
    angles = np.linspace(0, 6.28, 50)
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        assert value_at(layer, 1.0 + 1.5 * c, -2.0 + 1.5 * s) < 0
        assert value_at(layer, 1.0 + 2.8 * c, -2.0 + 2.8 * s) < 0
        assert value_at(layer, 1.0 + 3.2 * c, -2.0 + 3.2 * s) == 0
    hits = np.argwhere(layer.log_odds > 0)
    centres = (hits[:, ::-1] + 0.5) * 0.05 + layer.origin_xy_m
    radius = np.hypot(centres[:, 0] - 1.0, centres[:, 1] + 2.0)
    assert len(hits) > 300
    np.testing.assert_allclose(radius, 3.0, atol=0.05)


def test_walls_seen_again_and_again_stay_walls():
    grid = OccupancyGrid(0.05)
    for turn in range(30):
        grid.insert(se3.from_xy_yaw(0, 0, 0.01 * turn), scan_of(np.full(360, 2.5)))
    ring = grid.layer().log_odds.max()
    assert ring == np.float32(3.5)
    assert grid.layer().log_odds.min() == np.float32(-3.5)


def test_beam_without_measurement_clears_nothing():
    grid = OccupancyGrid(0.05)
    grid.insert(se3.identity(), scan_of(np.full(100, np.nan)))
    assert (grid.layer().log_odds >= 0).mean() > 0.99


def test_beam_without_return_clears_only_so_far():
    grid = OccupancyGrid(0.1)
    grid.insert(se3.identity(), scan_of(np.full(180, np.inf), range_max_m=80.0))
    layer = grid.layer()
    assert value_at(layer, 2.8, 0.05) < 0
    assert value_at(layer, 3.3, 0.05) == 0
    assert (layer.log_odds <= 0).all()


def test_a_layer_of_scans_is_drawn_as_the_scans_are():
    rng, poses = np.random.default_rng(0), [se3.from_xy_yaw(x, 0.1 * x, x) for x in (0.0, 0.7)]
    scans = [scan_of(rng.uniform(1.0, 9.0, 360)), scan_of(rng.uniform(1.0, 9.0, 180))]
    scans[0].ranges_m[:40] = [*[np.inf] * 10, *[np.nan] * 10, *[0.01] * 10, *[30.0] * 10]
    grid = OccupancyGrid(0.1)
    for scan, T in zip(scans, poses, strict=True):
        grid.insert(T, scan)
    layer = scan_layer(scans, poses, cell_m=0.1)
    found, expected = drawn(layer, layer.T_world_laser), grid.layer()
    assert (found.log_odds != expected.log_odds).mean() < 0.001  # angles are rounded
    assert found.origin_xy_m == expected.origin_xy_m
    assert 490 < len(walls(layer, layer.T_world_laser)) <= 320 + 180  # some share a cell
    nearer = scan_layer(scans, poses, cell_m=0.1, range_max_m=5.0)
    assert nearer.ranges_m.max() <= 5.0 and (nearer.ranges_m < 0).sum() > 100
    assert scan_layer([], [], cell_m=0.1).ranges_m.shape == (0, 0)


def test_ends_of_beams_lie_where_the_laser_is():
    (x, y, z) = walls(
        scan_layer([scan_of(np.array([2.0]))], [se3.identity()], cell_m=0.1),
        se3.from_parts(np.eye(3), np.array([[1.0, 2.0, 0.3]]))[None].reshape(1, 4, 4),
    )[0]
    angle = scan_of(np.array([2.0])).angles_rad[0]
    assert (x, y, z) == pytest.approx((1 + 2 * np.cos(angle), 2 + 2 * np.sin(angle), 0.3))


def test_door_that_opens_becomes_free():
    grid = OccupancyGrid(0.05)
    for _ in range(5):
        grid.insert(se3.identity(), scan_of(np.full(360, 2.0)))
    for _ in range(30):
        grid.insert(se3.identity(), scan_of(np.full(360, 3.0)))
    assert value_at(grid.layer(), 2.0, 0.02) < 0


def test_upside_down_laser_maps_the_same_world():
    ranges = np.linspace(1.0, 3.0, 360)
    upright, hanging = OccupancyGrid(0.05), OccupancyGrid(0.05)
    upright.insert(se3.identity(), scan_of(ranges))
    T_local_laser = np.diag([1.0, -1.0, -1.0, 1.0])
    turned = scan_of(ranges[::-1])
    turned = LaserScan(
        stamp_ns=0,
        ranges_m=turned.ranges_m,
        angle_min_rad=float(-upright_last_angle(upright, ranges)),
        angle_step_rad=turned.angle_step_rad,
        range_min_m=0.05,
        range_max_m=20.0,
    )
    hanging.insert(T_local_laser, turned)
    a, b = upright.layer(), hanging.layer()
    assert a.origin_xy_m == b.origin_xy_m
    assert ((a.log_odds > 0) != (b.log_odds > 0)).sum() <= 4


def upright_last_angle(_grid, ranges):
    return scan_of(ranges).angles_rad[-1]


def test_grid_grows_and_keeps_what_it_had():
    grid = OccupancyGrid(0.05)
    grid.insert(se3.identity(), scan_of(np.full(360, 2.0)))
    before = grid.layer()
    grid.insert(se3.from_xy_yaw(-30.0, 25.0, 0.0), scan_of(np.full(360, 2.0)))
    after = grid.layer()
    assert after.log_odds.size > before.log_odds.size
    for x_m, y_m in [(1.0, 0.3), (-2.0, 0.02), (0.0, -1.0)]:
        assert value_at(before, x_m, y_m) == value_at(after, x_m, y_m)


def test_memory_is_bounded():
    grid = OccupancyGrid(0.05, cells_max=300_000)
    grid.insert(se3.identity(), scan_of(np.full(360, 2.0)))
    size = grid.layer().log_odds.size
    grid.insert(se3.from_xy_yaw(1e6, 0.0, 0.0), scan_of(np.full(360, 2.0)))
    grid.insert(se3.identity(), scan_of(np.full(360, 1e5), range_max_m=1e6))
    assert grid.layer().log_odds.size == size


def test_empty_scan_is_no_error():
    grid = OccupancyGrid(0.05)
    scan = LaserScan(
        stamp_ns=0,
        ranges_m=np.zeros(0, np.float32),
        angle_min_rad=0.0,
        angle_step_rad=0.1,
        range_min_m=0.0,
        range_max_m=10.0,
    )
    grid.insert(se3.identity(), scan)
    assert not (grid.layer().log_odds > 0).any()


def test_layer_is_a_copy():
    grid = OccupancyGrid(0.05)
    grid.insert(se3.identity(), scan_of(np.full(360, 2.0)))
    layer = grid.layer()
    total = layer.log_odds.sum()
    grid.insert(se3.identity(), scan_of(np.full(360, 2.0)))
    assert layer.log_odds.sum() == total


def test_wrong_arguments_are_named():
    with pytest.raises(ConfigError, match="resolution_m"):
        OccupancyGrid(0.0)
    with pytest.raises(ConfigError, match="cells_max"):
        OccupancyGrid(0.1, cells_max=1)
