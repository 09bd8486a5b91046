"""One trajectory and one map, whatever the number of sessions."""

import numpy as np
import pytest

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.save import save_map
from sceneslam.types import se3
from sceneslam.types.maps import GridLayer, MapLayers, PointLayer
from sceneslam.types.trajectory import Trajectory


def wall_grid(resolution_m=0.1):
    """A grid of 2 m x 1 m: occupied along its right edge, free elsewhere."""
    log_odds = np.full((10, 20), -2.0, np.float32)
    log_odds[:, -1] = 3.0
    return GridLayer(log_odds=log_odds, resolution_m=resolution_m, origin_xy_m=(0.0, 0.0))


def atlas_of(*placed):
    atlas = Atlas(voxel_m=0.05)
    for module, T_map_local, layers in placed:
        atlas.close_session(atlas.begin_session(module, T_map_local), layers, Trajectory.empty())
    return atlas


def test_a_stamp_has_one_pose_the_first():
    atlas = Atlas(voxel_m=0.05)
    atlas.add(1, se3.identity(), "a")
    atlas.add(1, se3.from_xy_yaw(1, 0, 0), "b")
    assert len(atlas.trajectory) == 1 and atlas.pose_modules == ("a",)
    assert atlas.pose_at(1) is not None and atlas.pose_at(2) is None


def test_points_of_all_sessions_lie_in_the_map():
    cloud = PointLayer(points=np.array([[1, 0, 0]], np.float32))
    turned = se3.from_xy_yaw(5.0, 0.0, np.pi / 2)
    hybrid = atlas_of(
        ("bright", se3.identity(), MapLayers(points=cloud)),
        ("dark", turned, MapLayers(points=cloud)),
    ).fuse_maps()
    np.testing.assert_allclose(hybrid.points.points, [[1, 0, 0], [5, 1, 0]], atol=1e-6)
    assert [hybrid.modules[i] for i in hybrid.point_modules] == ["bright", "dark"]


def test_points_are_thinned_per_module_and_voxel():
    crowd = PointLayer(points=np.full((100, 3), -0.01, np.float32))
    layers = MapLayers(points=crowd)
    hybrid = atlas_of(("a", se3.identity(), layers), ("b", se3.identity(), layers)).fuse_maps()
    assert len(hybrid.points.points) == 2


def test_grids_add_up_where_they_overlap():
    layers = MapLayers(grid=wall_grid())
    once = atlas_of(("a", se3.identity(), layers)).fuse_maps().grid
    twice = atlas_of(("a", se3.identity(), layers), ("b", se3.identity(), layers)).fuse_maps().grid
    np.testing.assert_allclose(once.log_odds, wall_grid().log_odds)
    np.testing.assert_allclose(twice.log_odds, 2 * wall_grid().log_odds)


@pytest.mark.parametrize("yaw_rad", [0.0, np.pi / 2, np.pi, 0.4])
def test_wall_of_a_turned_grid_stands_where_it_should(yaw_rad):
    T_map_local = se3.from_xy_yaw(3.0, -2.0, yaw_rad)
    grid = atlas_of(("a", T_map_local, MapLayers(grid=wall_grid()))).fuse_maps().grid
    row, column = np.nonzero(grid.log_odds > 1)
    x_m = grid.origin_xy_m[0] + (column + 0.5) * grid.resolution_m
    y_m = grid.origin_xy_m[1] + (row + 0.5) * grid.resolution_m
    local = se3.apply(se3.inverse(T_map_local), np.column_stack([x_m, y_m, np.zeros_like(x_m)]))
    assert len(row) >= 8
    assert abs(local[:, 0] - 1.95).max() < 0.1 and local[:, 1].min() > -0.1
    assert local[:, 1].max() < 1.1


def test_saved_map_is_what_map_server_and_ply_readers_expect(tmp_path):
    cloud = PointLayer(
        points=np.array([[1, 2, 3]], np.float32), colors_bgr=np.array([[10, 20, 30]], np.uint8)
    )
    save_map(
        atlas_of(("a", se3.identity(), MapLayers(points=cloud, grid=wall_grid()))).fuse_maps(),
        tmp_path,
    )
    header, _, body = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 1" in header and len(body) == 16
    assert list(body[12:15]) == [30, 20, 10]
    pgm = (tmp_path / "grid.pgm").read_bytes()
    assert pgm.startswith(b"P5\n20 10\n255\n") and pgm[-1] == 0 and pgm[-2] == 254
    assert "resolution: 0.1" in (tmp_path / "grid.yaml").read_text()


def test_map_without_layers_is_saved_empty(tmp_path):
    save_map(Atlas(voxel_m=0.05).fuse_maps(), tmp_path)
    assert b"element vertex 0" in (tmp_path / "points.ply").read_bytes()
    assert not (tmp_path / "grid.pgm").exists()
