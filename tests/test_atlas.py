"""One trajectory and one map, whatever the number of sessions."""

from dataclasses import replace

import numpy as np
import pytest

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.pose_path import PosePath
from sceneslam.atlas.save import save_grid, save_map, save_nodes, save_points, save_pose_graph
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.scans.occupancy_grid import drawn, walls
from sceneslam.types import se3
from sceneslam.types.maps import (
    GridLayer,
    LandmarkLayer,
    MapLayers,
    PointLayer,
    PoseGraphLayer,
    ScanLayer,
)
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


def test_grid_that_lies_too_far_away_is_left_out_and_the_rest_is_kept(caplog):
    layers = MapLayers(grid=wall_grid(), points=PointLayer(points=np.ones((1, 3), np.float32)))
    far = se3.from_xy_yaw(1e6, 1e6, 0.0)
    found = atlas_of(("b", far, layers), ("a", se3.identity(), layers)).fuse_maps()
    np.testing.assert_allclose(found.grid.log_odds, wall_grid().log_odds)
    assert len(found.points.points) == 2 and "the grid of b is left out" in caplog.text


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


def test_saved_pose_graph_is_what_gtsam_reads(tmp_path):
    gtsam = pytest.importorskip("gtsam")
    T_map_node = np.stack([se3.identity(), se3.from_xy_yaw(1.0, 0.0, 0.0)])
    measured = PoseGraphLayer(
        stamps_ns=np.array([1, 2_000_000_003]),
        T_world_base=T_map_node,
        edges=np.array([[0, 1]]),
        T_from_to=T_map_node[1:],
        information=np.diag([1.0, 2, 3, 4, 5, 6])[None] + 0.5,
        is_loop=np.array([False]),
    )
    save_pose_graph(measured, tmp_path / "pose_graph.g2o")
    graph, values = gtsam.readG2o(str(tmp_path / "pose_graph.g2o"), True)
    np.testing.assert_allclose(values.atPose3(1).translation(), [1, 0, 0])
    information = gtsam.BetweenFactorPose3.noiseModel(graph.at(0)).information()
    np.testing.assert_allclose(np.diag(information), [4.5, 5.5, 6.5, 1.5, 2.5, 3.5])
    save_nodes(measured, tmp_path / "pose_graph.tum")
    assert Trajectory.read_tum(tmp_path / "pose_graph.tum").stamps_ns.tolist() == [1, 2_000_000_003]


@pytest.mark.parametrize("dtype", [np.int64, np.int32, np.uint16])
def test_saved_landmarks_say_where_they_come_from(tmp_path, dtype):
    landmarks = LandmarkLayer(
        points=np.array([[1, 2, 3]], np.float32),
        first_stamps_ns=np.array([1_500_000_000]),
        sightings=np.array([7], dtype),
    )
    save_map(atlas_of(("a", se3.identity(), MapLayers(landmarks=landmarks))).fuse_maps(), tmp_path)
    header, _, body = (tmp_path / "landmarks.ply").read_bytes().partition(b"end_header\n")
    assert b"property double first_seen_s\nproperty int sightings" in header
    row = np.frombuffer(body, "<f4,<f4,<f4,<f8,<i4,u1")[0]
    assert row.tolist() == (1.0, 2.0, 3.0, 1.5, 7, 0)


def test_a_saved_grid_is_black_white_and_grey_at_the_thresholds_it_names(tmp_path):
    limits = [np.log(0.65 / 0.35), np.log(0.196 / 0.804)]
    values = [[limits[0] + 0.01, limits[0] - 0.01, 0.0], [limits[1] + 0.01, limits[1] - 0.01, -9.0]]
    grid = GridLayer(
        log_odds=np.array(values, np.float32), resolution_m=0.25, origin_xy_m=(-1.5, 2.0)
    )
    save_grid(grid, tmp_path / "grid.yaml")
    pixels = (tmp_path / "grid.pgm").read_bytes().removeprefix(b"P5\n3 2\n255\n")
    assert list(pixels) == [205, 254, 254, 0, 205, 205]  # the highest y first
    assert (tmp_path / "grid.yaml").read_text().splitlines() == [
        "image: grid.pgm",
        "resolution: 0.25",
        "origin: [-1.500000, 2.000000, 0.0]",
        "negate: 0",
        "occupied_thresh: 0.65",
        "free_thresh: 0.196",
    ]


def test_points_that_no_module_coloured_are_saved_with_their_module(tmp_path):
    cloud = PointLayer(points=np.array([[1, 2, 3], [4, 5, 6]], np.float32))
    hybrid = atlas_of(("b", se3.identity(), MapLayers(points=cloud))).fuse_maps()
    save_points(replace(hybrid, points=cloud), tmp_path / "points.ply")
    header, _, body = (tmp_path / "points.ply").read_bytes().partition(b"end_header\n")
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment module 0 b",
        "element vertex 2",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue", "module")),
    ]
    rows = np.frombuffer(body, "<f4,<f4,<f4,u1,u1,u1,u1")
    assert rows.tolist() == [(1, 2, 3, 0, 0, 0, 0), (4, 5, 6, 0, 0, 0, 0)]


def test_a_session_lies_in_the_map_as_the_middle_one_of_its_poses_is_corrected():
    atlas = Atlas(voxel_m=0.05)
    for session in range(2):
        atlas.begin_session("ab"[session], se3.identity())
        for index in range(4):
            atlas.add(10 * session + index, se3.from_xy_yaw(index, 0, 0), "ab"[session])
            atlas.report(10 * session + index)
    shifts = [se3.from_xy_yaw(0.0, 0.1 * index, 0.0) for index in range(4)]
    atlas._correction = Correction(stamps_ns=np.arange(10, 14), T_new_old=np.stack(shifts))
    assert [one.T_map_local[1, 3] for one in atlas.sessions] == pytest.approx([0.0, 0.2])
    np.testing.assert_allclose(atlas.trajectory.positions_m[4:, 1], [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(atlas.online.positions_m[:, 1], np.zeros(8))


def scans_at(*x_m):
    """Scans of 16 beams of 2 m, one a nanosecond from 10 on."""
    count = len(x_m)
    return ScanLayer(
        stamps_ns=np.arange(10, 10 + count),
        T_world_laser=np.array([se3.from_xy_yaw(x, 0.0, 0.1) for x in x_m]).reshape(-1, 4, 4),
        ranges_m=np.full((count, 16), 2.0, np.float32),
        angle_min_rad=np.zeros(count),
        angle_step_rad=np.full(count, np.pi / 8),
        cell_m=0.1,
    )


def scanned(layers, shifts_m):
    """An atlas with one session, which is corrected sideways at its poses at 10, 11 and so on."""
    atlas, T_map_local = Atlas(voxel_m=0.01), se3.from_xy_yaw(3.0, 0.0, np.pi / 2)
    session = atlas.begin_session("a", T_map_local)
    for index in range(3):
        atlas.add_local(10 + index, se3.from_xy_yaw(index, 0, 0))
        atlas.add(10 + index, T_map_local @ se3.from_xy_yaw(index, 0, 0), "a")
    atlas.close_session(session, layers, Trajectory.empty())
    T_new_old = np.array([se3.from_xy_yaw(y_m, y_m, 0.0) for y_m in shifts_m])
    atlas._correction = Correction(stamps_ns=np.arange(10, 13), T_new_old=T_new_old)
    return atlas.fuse_maps(), T_new_old @ T_map_local


@pytest.mark.parametrize("shifts_m", [[0.0, 0.0, 0.0], [0.1, 0.5, 1.3]])
def test_each_scan_is_drawn_where_the_correction_within_its_session_puts_it(shifts_m):
    scans = scans_at(0.0, 1.0, 2.0)
    found, T_map_local = scanned(MapLayers(scans=scans), shifts_m)
    T_map_laser = T_map_local @ scans.T_world_laser
    np.testing.assert_allclose(found.points.points, walls(scans, T_map_laser), atol=1e-5)
    assert (found.points.colors_bgr == 160).all() and found.modules == ("a",)
    expected = drawn(scans, T_map_laser)
    np.testing.assert_array_equal(found.grid.log_odds, expected.log_odds)
    assert found.grid.origin_xy_m == pytest.approx(expected.origin_xy_m)
    assert found.grid.resolution_m == 0.1


def test_a_session_with_points_and_scans_gives_its_points_and_the_grid_of_its_scans():
    cloud = PointLayer(points=np.array([[1, 2, 3]], np.float32))
    found, _ = scanned(MapLayers(points=cloud, scans=scans_at(0.0, 1.0, 2.0)), [0.0] * 3)
    np.testing.assert_allclose(found.points.points, [[1, 1, 3]], atol=1e-6)
    assert (found.grid.log_odds > 0).sum() > 20


@pytest.mark.parametrize("layers", [MapLayers(), MapLayers(scans=scans_at())])
def test_a_session_without_scans_or_grid_gives_none(layers):
    found, _ = scanned(layers, [0.1, 0.5, 1.3])
    assert found.grid is None and len(found.points.points) == 0


def test_the_map_of_a_session_whose_poses_were_replaced_is_corrected_as_well():
    atlas = Atlas(voxel_m=0.05)
    layers = MapLayers(points=PointLayer(points=np.array([[1.0, 2.0, 0.0]], np.float32)))
    for module in "ab":
        atlas.rewind(0)
        atlas.begin_session(module, se3.identity())
        for stamp_ns in range(5):
            atlas.add_local(stamp_ns, se3.identity())
            atlas.add(stamp_ns, se3.identity(), module)
    T_new_old = se3.from_xy_yaw(5.0, 0.0, np.pi / 2)
    atlas.correct(Correction(stamps_ns=np.array([0]), T_new_old=T_new_old[None]))
    for session in range(2):
        atlas.close_session(session, layers, Trajectory.empty())
    np.testing.assert_allclose(atlas.fuse_maps().points.points, [[3.0, 1.0, 0.0]] * 2, atol=1e-6)


def test_the_covariance_of_a_map_lasts_until_another_is_reported():
    path, drifted = PosePath(), np.zeros((6, 6))
    drifted[5, 5] = 0.01  # of the heading alone
    path.add(0, se3.identity(), "laser", 0, None, drifted)
    path.add(1, se3.from_xy_yaw(2.0, 0.0, 0.0), "", 0, None, None)
    path.add(2, se3.from_xy_yaw(2.0, 0.0, 0.0), "laser", 1, None, None)  # another session
    of_maps = path.of_maps()
    assert of_maps[1, 1, 1] == pytest.approx(0.04) and of_maps[1, 5, 5] == pytest.approx(0.01)
    assert np.isnan(of_maps[2]).all() and (path.known_at(2).of_map == 0).all()
