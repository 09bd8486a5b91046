"""What the back end computes of loops and layers, up to its limits."""

from dataclasses import replace

import numpy as np
import pytest
from planar_poses import transforms
from test_atlas_submaps import RIG, S, at, run_of

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.fusion import Placed, fuse, one_per_voxel
from sceneslam.atlas.lasting.map_files import load_map_files
from sceneslam.atlas.lasting.merge import side_by_side
from sceneslam.atlas.lasting.prune import prune
from sceneslam.atlas.lasting.saved_map import SavedMap, empty_map
from sceneslam.atlas.pose_path import trajectory_of
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.atlas.submaps.graph import consistent, on_floor
from sceneslam.atlas.submaps.own_loops import closed_loops
from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar, se3
from sceneslam.types.maps import GridLayer, MapLayers, PointLayer, PoseGraphLayer
from sceneslam.types.observation import Observation
from sceneslam.types.rows import Rows

# Loops.


def loop(first, second, T_first_second, sigma=0.1):
    return Edge(
        first=first,
        second=second,
        T_first_second=planar.to_transform(np.array(T_first_second)),
        covariance=on_floor(np.diag([sigma**2, sigma**2, 0.01**2])),
        kind=EdgeKind.LOOP,
    )


def agree(off_m, *, apart_m=0.0, drift=None):
    """Tell whether two loops agree that differ by `off_m`, their ends `apart_m` from each other."""
    nodes = np.array([[0, 0, 0], [0, 0, 0], [10, 0, 0], [10 + apart_m, 0, 0]], float)
    drift = np.zeros((4, 3)) if drift is None else drift
    drift = PathDrift(sums=np.stack([drift, np.zeros_like(drift)], axis=1))
    loops = [loop(0, 2, [10, 0, 0]), loop(1, 3, [10 + apart_m + off_m, 0, 0])]
    return len(consistent(loops, transforms(nodes), drift)) == 2


def test_loops_agree_within_the_99th_percentile_of_their_uncertainty():
    bound_m = np.sqrt(16.81) * np.sqrt(2) * 0.1
    for sign in (1.0, -1.0):
        assert agree(sign * 0.999 * bound_m) and not agree(sign * 1.001 * bound_m)


def test_loops_apart_agree_within_what_their_headings_and_the_path_allow():
    bound_m = np.sqrt(16.81) * np.sqrt(2) * 0.1  # the headings move the ends sideways
    assert agree(0.999 * bound_m, apart_m=3.0) and not agree(1.001 * bound_m, apart_m=3.0)
    drift = np.zeros((4, 3))
    drift[2], drift[3] = [0.1, 0.1, 0.02], [0.4, 0.4, 0.08]
    path_m, measured_m = 0.3 + 0.5 * 3.0 * 0.06, np.sqrt(2) * 0.1
    bound_m = np.sqrt(16.81) * np.hypot(path_m, measured_m)
    assert agree(0.999 * bound_m, apart_m=3.0, drift=drift)
    assert not agree(1.001 * bound_m, apart_m=3.0, drift=drift)


def test_the_largest_set_of_loops_that_agree_is_kept():
    nodes = transforms(np.zeros((12, 3)))
    offs = [0.0, 5.0, 0.0, 5.0, 5.0, 9.0]
    loops = [loop(2 * i, 2 * i + 1, [off, 0, 0]) for i, off in enumerate(offs)]
    assert consistent(loops, nodes, PathDrift.along([], 12)) == [1, 3, 4]
    assert consistent(loops[:1], nodes, PathDrift.along([], 12)) == [0]
    assert consistent([], nodes, PathDrift.along([], 12)) == []


def test_a_motion_in_the_plane_keeps_height_and_tilt_as_a_floor_does():
    covariance = np.diag([0.04, 0.09, 0.01])
    expected = [0.04, 0.09, 0.05**2, 0.02**2, 0.02**2, 0.01]
    np.testing.assert_allclose(on_floor(covariance), np.diag(expected))
    shifted = loop(1, 4, [1.0, 2.0, 0.3]).shifted(2)
    assert (shifted.first, shifted.second) == (3, 6)


def test_loops_of_modules_have_their_stamps_and_the_inverse_of_their_information():
    information = np.stack([np.diag([4.0, 25.0, 1.0, 100.0, 1.0, 1.0])] * 3)
    poses = np.stack([at(1.0), at(2.0), at(3.0)])
    graph = PoseGraphLayer(
        stamps_ns=np.array([10, 20, 30]),
        T_world_base=poses,
        edges=np.array([[0, 1], [1, 2], [0, 2]]),
        T_from_to=poses,
        information=information,
        is_loop=np.array([False, False, True]),
    )
    (closed,) = closed_loops([MapLayers(), MapLayers(pose_graph=graph)])
    assert (closed.first, closed.second) == (10, 30)
    np.testing.assert_array_equal(closed.T_first_second, at(3.0))
    expected = np.diag([0.25, 0.04, 1.0, 0.01, 1.0, 1.0]) + 1e-6 * np.eye(6)
    np.testing.assert_allclose(closed.covariance, expected)


def test_what_a_loop_of_a_module_did_not_measure_is_unknown():
    """A graph in the plane says nothing about height and tilt."""
    graph = PoseGraphLayer(
        stamps_ns=np.array([10, 20]),
        T_world_base=np.stack([at(0.0), at(1.0)]),
        edges=np.array([[0, 1]]),
        T_from_to=at(1.0)[None],
        information=np.diag([100.0, 100.0, 0.0, 0.0, 0.0, 400.0])[None],
        is_loop=np.array([True]),
    )
    (closed,) = closed_loops([MapLayers(pose_graph=graph)])
    expected = [0.01, 0.01, 1e6, 1e6, 1e6, 0.0025]
    np.testing.assert_allclose(np.diag(closed.covariance), expected, rtol=1e-3)


@pytest.mark.parametrize("unknown", [1e16, np.finfo(float).max])
def test_a_covariance_that_says_unknown_costs_no_map(tmp_path, unknown):
    own = Atlas(voxel_m=0.05, save=str(tmp_path / "map"))
    own.open(RIG, lambda *_, **__: None)
    own.begin_session("a", np.eye(4))
    for index in range(80):
        T, covariance = at(0.1 * index, 0.0, 0.03 * index), np.diag([1e-4, 1e-4, *[unknown] * 4])
        own.add(index * S, T, "a", covariance)
        own.observe(Observation(stamp_ns=index * S), None)
    assert own.finish() == []
    assert len(own.fuse_maps().pose_graph.edges) == len(load_map_files(tmp_path / "map").edges) > 1
    assert np.isfinite(own.covariances(None)).all()


@pytest.mark.parametrize("sigma_yaw", [1e-6, 0.1])
def test_a_correction_is_interpolated_between_nodes_and_kept_outside(sigma_yaw):
    correction = Correction(
        stamps_ns=np.array([10 * S, 20 * S]), T_new_old=np.stack([at(1.0), at(3.0, 2.0)])
    )
    stamps_ns = np.array([0, 10, 15, 20, 30]) * S
    moved = correction.apply(stamps_ns, np.tile(at(5.0, 0.0, sigma_yaw), (5, 1, 1)))
    expected = [[6, 0], [6, 0], [7, 1], [8, 2], [8, 2]]
    np.testing.assert_allclose(moved[:, :2, 3], expected, atol=1e-9)
    one = Correction(stamps_ns=np.array([10 * S]), T_new_old=at(1.0)[None])
    np.testing.assert_allclose(one.apply(stamps_ns, np.tile(at(), (5, 1, 1)))[:, 0, 3], 1.0)


# Layers of all sessions in one map.


def test_one_point_is_kept_per_voxel_and_owner():
    points = np.array(
        [[0.01, 0, 0], [0.09, 0, 0], [0.11, 0, 0], [0.01, 0.11, 0], [0.01, 0, 0.11], [-0.01, 0, 0]],
        np.float32,
    )
    owner = np.zeros(6, np.uint8)
    assert one_per_voxel(points, owner, 0.1).tolist() == [0, 2, 3, 4, 5]
    owner[1] = 255
    assert one_per_voxel(points, owner, 0.1).tolist() == [0, 1, 2, 3, 4, 5]
    rng = np.random.default_rng(0)
    many = rng.uniform(-2.0, 2.0, (3000, 3)).astype(np.float32)
    owners = rng.integers(0, 3, 3000).astype(np.uint8)
    cells = np.column_stack([np.floor(many / 0.3), owners])
    _, first = np.unique(cells, axis=0, return_index=True)
    assert one_per_voxel(many, owners, 0.3).tolist() == sorted(first.tolist())


def grid(values, *, resolution_m=0.5, origin=(0.0, 0.0)):
    return GridLayer(
        log_odds=np.array(values, np.float32), resolution_m=resolution_m, origin_xy_m=origin
    )


def put(module, T_map_local, layers):
    return Placed(module=module, T_map_local=T_map_local, layers=layers)


def fused(*placed):
    layers = [put("a", T, MapLayers(grid=one)) for T, one in placed]
    return fuse(layers, voxel_m=0.1).grid


def test_a_grid_stays_as_it_is_and_is_moved_by_whole_cells():
    one = grid([[1, 2, 3], [4, 5, 6]], origin=(-1.0, 0.5))
    for T, origin in ((at(), (-1.0, 0.5)), (at(1.5, -2.0), (0.5, -1.5))):
        found = fused((T, one))
        np.testing.assert_array_equal(found.log_odds, one.log_odds)
        assert found.origin_xy_m == origin and found.resolution_m == 0.5


def test_grids_are_summed_up_to_a_limit_at_the_finer_resolution():
    coarse, fine = grid([[4, -6]], resolution_m=1.0), grid([[8, 1, -6, 1], [0, 0, 0, 0]])
    found = fused((at(), coarse), (at(), fine))
    np.testing.assert_array_equal(found.log_odds, [[10, 5, -10, -5], [4, 4, -6, -6]])
    assert found.resolution_m == 0.5


@pytest.mark.parametrize("resolution_m", [5e-324, 1e-19, 1e-6, 1e6, 1e308])
def test_a_grid_whose_cells_are_of_no_sensible_size_is_left_out_by_name(caplog, resolution_m):
    good, odd = grid([[1, 2], [3, 4]]), grid(np.ones((30, 30)), resolution_m=resolution_m)
    layers = [put("b", at(1.0), MapLayers(grid=odd)), put("a", at(), MapLayers(grid=good))]
    found = fuse(layers, voxel_m=0.1).grid
    np.testing.assert_array_equal(found.log_odds, good.log_odds)
    assert found.resolution_m == 0.5 and "the grid of b is left out" in caplog.text


def test_points_without_a_colour_are_grey_and_know_their_module():
    cloud = PointLayer(points=np.array([[0, 0, 0], [5, 0, 0]], np.float32))
    colored = replace(cloud, colors_bgr=np.full((2, 3), 7, np.uint8))
    placed = [
        put("b", at(), MapLayers(points=cloud)),
        put("a", at(1.0), MapLayers(points=colored)),
        put("b", at(2.0), MapLayers(points=cloud)),
    ]
    found = fuse(placed, voxel_m=0.1)
    assert found.modules == ("b", "a") and found.point_modules.tolist() == [0, 0, 1, 1, 0, 0]
    np.testing.assert_allclose(found.points.points[:, 0], [0, 5, 1, 6, 2, 7])
    assert found.points.colors_bgr[:, 0].tolist() == [160, 160, 7, 7, 160, 160]


def test_rows_grow_are_cut_and_are_read_back():
    rows, given = Rows(2), np.arange(1400.0).reshape(700, 2)
    for row in given:
        rows.append(row)
    np.testing.assert_array_equal(np.asarray(rows), given)
    np.testing.assert_array_equal(rows[-1], given[-1])
    np.testing.assert_array_equal(rows[256], given[256])
    for count in (513, 512, 511, 0):
        rows.cut(count)
        assert len(rows) == count and np.asarray(rows).shape == (count, 2)
        np.testing.assert_array_equal(np.asarray(rows), given[:count])
    rows.append(given[3])
    rows.cut(5)
    np.testing.assert_array_equal(list(rows), given[3:4])
    with pytest.raises(IndexError):
        rows[1]
    assert len(trajectory_of([], Rows(4, 4))) == 0


# Maps of several runs.


def a_map(count=3, *, runs=(0, 0, 1)):
    own = run_of(6 * count)
    own.finish()
    submaps = tuple(replace(one, run=runs[i]) for i, one in enumerate(own.chain.submaps))
    return SavedMap(
        submaps=submaps,
        T_map_node=np.array(own.chain.T_run_node),
        pieces=np.array([0, 0, 1]),
        edges=tuple(own.chain.motions),
    )


def test_two_maps_side_by_side_keep_their_runs_pieces_and_motions_apart():
    both = side_by_side(a_map(), a_map())
    assert both.runs == 4 and [submap.run for submap in both.submaps] == [0, 0, 1, 2, 2, 3]
    assert both.pieces.tolist() == [0, 0, 1, 2, 2, 3]
    assert [(edge.first, edge.second) for edge in both.edges] == [(0, 1), (1, 2), (3, 4), (4, 5)]
    alone = side_by_side(empty_map(), a_map())
    assert alone.pieces.tolist() == [0, 0, 1] and alone.runs == 2 and empty_map().runs == 0


def test_motions_through_a_removed_submap_are_composed_with_their_uncertainty():
    """Submaps without walls are covered by any later one of their piece."""
    nodes = np.array([[0, 0, 0], [1, 0, 0.5], [1, 2, 1.0]], float)
    planes = np.diag([1e-4, 4e-4, 1e-3]), np.diag([9e-4, 1e-4, 4e-3])
    covariances = [on_floor(covariance) for covariance in planes]
    motions = [
        Edge(
            first=row,
            second=row + 1,
            T_first_second=planar.to_transform(planar.between(nodes[row], nodes[row + 1])),
            covariance=covariances[row],
            kind=kind,
        )
        for row, kind in enumerate((EdgeKind.MOTION, EdgeKind.BRIDGE))
    ]
    saved = replace(
        a_map(), T_map_node=transforms(nodes), edges=tuple(motions), pieces=np.array([1, 0, 0])
    )
    thinned = prune(saved)
    assert len(thinned.submaps) == 2 and thinned.pieces.tolist() == [1, 0]
    (edge,) = thinned.edges
    assert (edge.first, edge.second, edge.kind) == (0, 1, EdgeKind.BRIDGE)
    np.testing.assert_allclose(edge.T_first_second, planar.to_transform(nodes[2]), atol=1e-12)
    carry = se3.adjoint(se3.inverse(motions[1].T_first_second))
    expected = carry @ covariances[0] @ carry.T + covariances[1]
    np.testing.assert_allclose(edge.covariance, expected, atol=1e-12)


def corrections(*shifts_m, stamps_s=None):
    stamps_s = range(len(shifts_m)) if stamps_s is None else stamps_s
    return Correction(
        stamps_ns=np.array(list(stamps_s), np.int64) * S,
        T_new_old=np.array([at(shift_m) for shift_m in shifts_m]).reshape(-1, 4, 4),
    )


def test_a_correction_is_updated_where_it_changed_by_a_centimetre_and_at_its_end():
    before = corrections(0.0, 0.0, 0.0, 0.0)
    after = corrections(0.009, -0.011, 0.0, 0.005, 0.006)
    changes = after.changes(before)
    assert (changes.stamps_ns // S).tolist() == [1, 4]
    updated = before.updated(changes)
    assert (updated.stamps_ns // S).tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(updated.T_new_old[:, 0, 3], [0, -0.011, 0, 0, 0.006])
    np.testing.assert_array_equal(Correction.none().updated(after).T_new_old, after.T_new_old)
    assert (after.changes(Correction.none()).stamps_ns == after.stamps_ns).all()
    for turn_rad, rows in ((0.0049, [1]), (0.0051, [0, 1])):
        turned = replace(after, stamps_ns=after.stamps_ns[:2], T_new_old=np.array([at()] * 2))
        turned.T_new_old[0] = at(0.0, 0.0, turn_rad)
        changes = turned.changes(corrections(0.0, 0.0))
        assert (changes.stamps_ns // S).tolist() == rows


def test_nodes_that_a_correction_has_no_more_take_its_values_there():
    before = corrections(0.0, 0.0, 50.0, 50.0, stamps_s=[0, 4, 9, 12])
    after = corrections(0.0, 0.02, 0.06, stamps_s=[0, 4, 10])
    changes = after.changes(before)
    assert (changes.stamps_ns // S).tolist() == [4, 9, 10, 12]
    updated = before.updated(changes)
    later = np.arange(0, 20) * S
    poses = np.array([at(float(k)) for k in range(20)])
    np.testing.assert_allclose(updated.apply(later, poses), after.apply(later, poses), atol=1e-9)
    assert (after.changes(updated).stamps_ns // S).tolist() == [12]  # each is told once


def test_a_correction_is_cut_before_replaced_poses_but_for_its_first_node():
    whole = corrections(0.1, 0.2, 0.3)
    for second, left in ((3, 3), (2, 2), (1, 1), (0, 1)):
        assert len(whole.cut(second * S).stamps_ns) == left
