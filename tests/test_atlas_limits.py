"""What the back end computes of poses, loops and layers, up to its limits."""

from dataclasses import replace

import numpy as np
import pytest
from planar_poses import transforms

from sceneslam.atlas.fusion import Placed, fuse, one_per_voxel
from sceneslam.atlas.lasting.merge import side_by_side
from sceneslam.atlas.lasting.prune import prune
from sceneslam.atlas.lasting.saved_map import SavedMap, empty_map
from sceneslam.atlas.pose_path import trajectory_of
from sceneslam.atlas.rows import Rows
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.correction import Correction
from sceneslam.atlas.submaps.graph import consistent, on_floor
from sceneslam.atlas.submaps.own_loops import closed_loops
from sceneslam.atlas.submaps.submap import KeyPose, OpenSubmap, make_submap, motion_covariance
from sceneslam.atlas.uncertainty import GYRO, MAPPED, VELOCITY, WHEELS, drifted
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.types import planar, se3
from sceneslam.types.maps import GridLayer, MapLayers, PointLayer, PoseGraphLayer
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import BRIDGED

S = 10**9
RIG = Rig(sensors=frozenset({Sensor.ODOMETRY}))


def at(x_m=0.0, y_m=0.0, yaw_rad=0.0):
    return se3.from_xy_yaw(x_m, y_m, yaw_rad)


def pitched(x_m, z_m=0.0, pitch_rad=0.0):
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, pitch_rad, 0.0]))
    T[:3, 3] = x_m, 0.0, z_m
    return T


# The covariance of a motion.


@pytest.mark.parametrize("drift", [WHEELS, VELOCITY, MAPPED])
@pytest.mark.parametrize(("way_m", "turn_rad"), [(2.0, 0.0), (0.0, 0.5), (2.0, 0.5)])
def test_a_motion_drifts_as_its_kind(drift, way_m, turn_rad):
    systematic = drift.rad_per_m * way_m + drift.rad_per_rad * turn_rad
    turn2 = systematic**2 + drift.rad_per_root**2 * (way_m + turn_rad)
    shift2 = (drift.per_m * way_m) ** 2 + turn2 * (0.5 * way_m) ** 2
    expected = np.diag(np.repeat([shift2, turn2], 3))
    np.testing.assert_allclose(drifted(drift, np.array([way_m, turn_rad])), expected, atol=1e-15)


def key_pose(index, T_map_base, *, session=0, drift=MAPPED, reported=None):
    return KeyPose(
        stamp_ns=index * S,
        scan=None,
        T_map_base=T_map_base,
        session=session,
        module="a",
        drift=drift,
        reported=reported,
    )


@pytest.mark.parametrize("drift", [MAPPED, WHEELS, VELOCITY])
def test_the_motion_between_two_submaps_is_as_uncertain_as_its_drift(drift):
    places = [at(), at(1.0, 0.0, 0.1), at(2.0, 0.0, -0.1)]
    poses = [key_pose(index, T, drift=drift) for index, T in enumerate(places)]
    systematic = drift.rad_per_m * 2.0 + drift.rad_per_rad * 0.3
    turn = np.hypot(systematic, drift.rad_per_root * np.sqrt(2.3))
    shift = np.hypot(drift.per_m * 2.0, turn * 1.0)  # half of the 2 m between the ends
    expected = np.repeat([shift**2 + 0.003**2, turn**2 + 0.002**2], 3)
    np.testing.assert_allclose(motion_covariance(poses), np.diag(expected))


def test_what_a_module_reports_adds_its_growth_within_one_session():
    reported = (1e-4 * np.eye(6), 3e-4 * np.eye(6))
    first, last = (key_pose(i, at(), reported=one) for i, one in enumerate(reported))
    least = np.repeat([0.003**2, 0.002**2], 3)
    np.testing.assert_allclose(motion_covariance([first, last]), np.diag(least + 2e-4))
    np.testing.assert_allclose(motion_covariance([last, first]), np.diag(least), atol=1e-15)
    other = replace(last, session=1)
    np.testing.assert_allclose(motion_covariance([first, other]), np.diag(least))


# Steps and submaps.


def collector(known=lambda stamp_ns: None, rig=RIG):
    return Collector(rig, known, 0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_is_a_tenth_of_a_metre_or_of_a_radian(sign):
    own = collector()
    assert own.has_moved(at())
    own.step_to(at())
    for little, enough in (
        (at(sign * 0.099), at(sign * 0.101)),
        (at(0.0, sign * 0.099), at(0.0, sign * 0.101)),
        (at(0.0, 0.0, sign * 0.099), at(0.0, 0.0, sign * 0.101)),
    ):
        assert not own.has_moved(little) and own.has_moved(enough)


def test_a_pose_is_level_up_to_three_degrees_and_a_slope_of_one_in_five():
    def is_level_after(T, steps=100):
        own = collector()
        assert all(own.step_to(at(0.1 * index)) for index in range(steps))
        return own.step_to(T)

    for sign in (1.0, -1.0):
        assert is_level_after(pitched(10.0, pitch_rad=sign * np.radians(2.9)))
        assert not is_level_after(pitched(10.0, pitch_rad=sign * np.radians(3.2)))
        assert is_level_after(pitched(9.9 + 0.5, z_m=sign * 0.099))
        assert not is_level_after(pitched(9.9 + 0.5, z_m=sign * 0.101))
        assert is_level_after(pitched(9.9, z_m=sign * 0.0199))  # of a step at least
        assert not is_level_after(pitched(9.9, z_m=sign * 0.0201))


def test_a_base_whose_steps_are_mostly_level_moves_on_a_floor():
    own = collector()
    for index in range(10):
        own.step_to(pitched(0.1 * index, z_m=0.5 * (index % 2) * (index < 6)))
    assert not own.is_level  # 4 of 10
    for index in range(10, 12):
        own.step_to(pitched(0.1 * index))
    assert own.is_level  # 6 of 12


def split(poses):
    """Group poses into submaps, each of which takes as many as it can."""
    parts = [OpenSubmap()]
    for pose in poses:
        if not parts[-1].take(pose):
            parts.append(OpenSubmap())
            assert parts[-1].take(pose)
    return [part.poses for part in parts]


def test_a_submap_ends_after_its_length_its_turn_and_its_session():
    ahead = [key_pose(index, at(0.25 * index)) for index in range(25)]
    assert [len(part) for part in split(ahead)] == [11, 11, 3]
    turning = [key_pose(index, at(0.0, 0.0, 0.5 * index)) for index in range(30)]
    assert [len(part) for part in split(turning)] == [13, 13, 4]
    two = [key_pose(index, at(), session=index // 4) for index in range(6)]
    assert [len(part) for part in split(two)] == [4, 2]
    third = make_submap(split(ahead)[1], run=3)
    assert (third.run, third.session, third.module) == (3, 0, "a")
    np.testing.assert_allclose(third.T_submap_base[-1], [2.5, 0.0, 0.0], atol=1e-12)
    assert third.stamps_ns[0] == 11 * S


def run_of(count, *, module=lambda i: "a", session=lambda i: 0, step_s=1):
    """Return a collector after so many steps of 0.5 m, one a second."""

    def known(stamp_ns):
        index = stamp_ns // (step_s * S)
        return Known(
            T_map_base=at(0.5 * index),
            session=session(index),
            module=module(index),
            covariance=None,
        )

    own = collector(known)
    for index in range(count):
        own.step_to(at(0.5 * index))
        own.add(index * step_s * S, None)
    return own


def test_a_submap_is_complete_as_soon_as_the_next_step_is_beyond_it():
    assert [len(run_of(count).chain) for count in (6, 7, 12, 13)] == [0, 1, 1, 2]
    own = run_of(41)
    assert [len(one.stamps_ns) for one in own.chain.submaps] == [6] * 6
    assert own.chain.submaps[-1].stamps_ns[-1] == 35 * S
    own.finish()
    assert [len(one.stamps_ns) for one in own.chain.submaps] == [6] * 6 + [5]
    node_at = own.chain.node_at
    assert node_at(0) == 0 and node_at(-5) == 0
    assert [node_at(index * S) for index in (5, 6, 35, 36, 99)] == [0, 1, 5, 6, 6]


def test_motions_lead_from_submap_to_submap_and_their_deviations_add_up():
    own = run_of(12)
    own.finish()
    (motion,) = own.chain.motions
    assert (motion.first, motion.second, motion.kind) == (0, 1, EdgeKind.MOTION)
    np.testing.assert_allclose(motion.T_first_second, at(3.0), atol=1e-12)
    np.testing.assert_array_equal(own.chain.drift[0], np.zeros(3))
    expected = np.sqrt(np.diag(planar.planar_covariance(motion.covariance)))
    np.testing.assert_allclose(own.chain.drift[1], expected)
    own.chain.remeasure(lambda stamp_ns: at(1.0 + 2 / 3 * stamp_ns / S))
    np.testing.assert_allclose(own.chain.motions[0].T_first_second, at(4.0), atol=1e-12)


@pytest.mark.parametrize(
    ("bridged", "kind"), [({1, 2, 3}, EdgeKind.MOTION), ({1, 2, 3, 4}, EdgeKind.BRIDGE)]
)
def test_a_motion_that_is_bridged_for_more_than_half_is_a_bridge(bridged, kind):
    own = run_of(7, module=lambda i: BRIDGED if i in bridged else "a")
    own.finish()
    assert own.chain.motions[0].kind is kind
    other = run_of(8, session=lambda i: i // 4)
    other.finish()
    assert [edge.kind for edge in other.chain.motions] == [EdgeKind.HANDOVER]


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
    assert consistent(loops, nodes, np.zeros((12, 3))) == [1, 3, 4]
    assert consistent(loops[:1], nodes, np.zeros((12, 3))) == [0]
    assert consistent([], nodes, np.zeros((12, 3))) == []


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
    assert (closed.from_ns, closed.to_ns) == (10, 30)
    np.testing.assert_array_equal(closed.T_from_to, at(3.0))
    expected = np.diag([0.25, 0.04, 1.0, 0.01, 1.0, 1.0]) + 1e-6 * np.eye(6)
    np.testing.assert_allclose(closed.covariance, expected)


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
        a_map(),
        T_map_node=transforms(nodes),
        edges=tuple(motions),
        pieces=np.array([1, 0, 0]),
    )
    thinned = prune(saved)
    assert len(thinned.submaps) == 2 and thinned.pieces.tolist() == [1, 0]
    (edge,) = thinned.edges
    assert (edge.first, edge.second, edge.kind) == (0, 1, EdgeKind.BRIDGE)
    np.testing.assert_allclose(edge.T_first_second, planar.to_transform(nodes[2]), atol=1e-12)
    carry = se3.adjoint(se3.inverse(motions[1].T_first_second))
    expected = carry @ covariances[0] @ carry.T + covariances[1]
    np.testing.assert_allclose(edge.covariance, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("sensors", "drift"),
    [
        ({Sensor.ODOMETRY}, WHEELS),
        ({Sensor.ODOMETRY, Sensor.GYRO}, GYRO),
        ({Sensor.GYRO}, VELOCITY),
        (set(), VELOCITY),
    ],
)
def test_a_bridge_drifts_as_the_sensors_that_measured_it(sensors, drift):
    def known(stamp_ns):
        index = stamp_ns // S
        return Known(T_map_base=at(0.5 * index), session=0, module=BRIDGED, covariance=None)

    own = collector(known, Rig(sensors=frozenset(sensors)))
    for index in range(12):
        own.add(index * S, None)
    own.finish()
    (motion,) = own.chain.motions
    poses = [key_pose(index, at(0.5 * index), drift=drift) for index in range(7)]
    np.testing.assert_allclose(motion.covariance, motion_covariance(poses))


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


def test_a_correction_is_cut_before_replaced_poses_but_for_its_first_node():
    whole = corrections(0.1, 0.2, 0.3)
    for second, left in ((3, 3), (2, 2), (1, 1), (0, 1)):
        assert len(whole.cut(second * S).stamps_ns) == left
