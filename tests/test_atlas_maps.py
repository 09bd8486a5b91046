"""Maps of several runs: what is kept, forgotten, joined, saved, and when."""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from planar_poses import transforms
from test_atlas_places import CELL, plan_of, quality, text_of

from sceneslam.atlas.lasting.map_files import save_map_files
from sceneslam.atlas.lasting.merge import join_pieces, side_by_side
from sceneslam.atlas.lasting.prune import prune
from sceneslam.atlas.lasting.saved_map import SavedMap, empty_map, forget_contradicted
from sceneslam.atlas.places.floor_plan import empty, join
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.submaps.graph import connected, on_floor
from sceneslam.atlas.submaps.submap import Drawing, Submap
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.maps.__main__ import main
from sceneslam.maps.inspect import described, flaws
from sceneslam.types import planar, se3

S = 10**9
WALL = plan_of("#" * 40)
PITCHED = np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])


def map_of(*plans, nodes=None, runs=None, pieces=None, edges=()):
    count = len(plans)
    return SavedMap(
        submaps=tuple(
            Submap(
                run=0 if runs is None else runs[index],
                session=index // 2,
                module="ab"[index % 2],
                stamps_ns=np.array([index * S, index * S + 1]),
                T_submap_base=np.array([[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]]),
                drawing=Drawing(plan),
            )
            for index, plan in enumerate(plans)
        ),
        T_map_node=transforms(np.zeros((count, 3)) if nodes is None else nodes),
        pieces=np.zeros(count, np.int64) if pieces is None else np.array(pieces),
        edges=tuple(edges),
    )


LOOP, KINDS = EdgeKind.LOOP, (EdgeKind.MOTION, EdgeKind.LOOP)


def edge(first, second, T_first_second=(1.0, 0.0, 0.0), kind=EdgeKind.MOTION):
    return Edge(
        first=first,
        second=second,
        T_first_second=planar.to_transform(np.array(T_first_second, float)),
        covariance=on_floor(np.diag([1e-4, 1e-4, 1e-5])),
        kind=kind,
    )


# What is forgotten.


def cross(length=9):
    half = length // 2
    bar = " " * half + "#" + " " * half
    return [bar] * half + ["#" * length] + [bar] * half


def test_walls_well_inside_what_the_newest_run_saw_free_are_forgotten():
    today, old = plan_of(*["....."] * 5), plan_of(*cross(), normal=(1.0, 0.0))
    at = [-2 * CELL, -2 * CELL, 0.0]
    left = forget_contradicted(map_of(old, today, nodes=[at, [0, 0, 0]], runs=[0, 1]), 1)
    kept = left.submaps[0].plan
    gap = [list(row) for row in cross()]
    for index in (3, 4, 5):
        gap[index][4] = gap[4][index] = " "
    assert text_of(kept) == ["".join(row) for row in gap]
    assert len(kept.normals) == len(kept.points)
    assert left.submaps[1].plan is today
    turned = [8 * CELL, -3 * CELL, np.pi / 2]
    wide = plan_of(*["." * 7] * 3)
    left = forget_contradicted(map_of(old, wide, nodes=[turned, [0, 0, 0]], runs=[0, 1]), 1)
    for index in (2, 6):
        gap[index][4] = " "
    for index in (3, 5):
        gap[4][index] = "#"
    assert text_of(left.submaps[0].plan) == ["".join(row) for row in gap]


def test_nothing_is_forgotten_of_other_pieces_or_far_away():
    today, old = plan_of(*["....."] * 5), plan_of("###")
    for node in ([50.0, 0, 0], [-50.0, 0, 0], [0, 50.0, 0], [0, -50.0, 0]):
        both = map_of(old, today, nodes=[node, [0, 0, 0]], runs=[0, 1])
        assert len(forget_contradicted(both, 1).submaps[0].plan) == 3
    node = [CELL, 2 * CELL, 0.0]
    for pieces, count in (([1, 0], 3), ([1, 1], 3), ([0, 0], 0)):
        both = map_of(old, today, nodes=[node, [0, 0, 0]], runs=[0, 1], pieces=pieces)
        assert len(forget_contradicted(both, 1).submaps[0].plan) == count


def test_what_was_free_is_forgotten_where_the_newest_run_saw_a_wall():
    old, today = plan_of("....#", "....."), plan_of(*cross(5))
    at = [-CELL, 0.0, 0.0]
    left = forget_contradicted(map_of(old, today, nodes=[at, [0, 0, 0]], runs=[0, 1]), 1)
    assert text_of(left.submaps[0].plan) == ["... #", "... ."]
    assert text_of(old) == ["....#", "....."]


def test_the_plan_of_a_piece_is_that_of_its_submaps_the_newest_last():
    room, inside = plan_of("#####"), plan_of(*["....."] * 3)
    nodes = [[0, 0, 0], [0, -CELL, 0], [0, 0, 0]]
    saved = map_of(room, inside, plan_of("##"), nodes=nodes, pieces=[0, 0, 1])
    assert text_of(saved.plan()) == [".....", "#...#", "....."]
    assert text_of(saved.plan(1)) == ["##"] and not len(saved.plan(2))


def test_a_robot_stands_on_the_floor_of_the_submap_that_begins_nearest():
    flat, other_piece = se3.identity(), se3.exp(np.array([9.0, 0.0, 2.0, 0.0, 0.0, 0.0]))
    ramp = se3.exp(np.array([10.0, 0.0, 2.0, 0.0, 0.0, 0.0])) @ se3.exp(PITCHED)
    nodes = [flat, flat, flat, ramp, other_piece]
    saved = replace(map_of(*[WALL] * 5, pieces=[0, 0, 0, 0, 1]), T_map_node=np.stack(nodes))
    askew = se3.exp(np.array([0.0, 0.0, 1.4, 0.05, 0.02, 0.0]))
    here, there = (se3.from_xy_yaw(*xy_yaw) for xy_yaw in ((1.0, 2.0, 0.5), (9.0, 0.0, 0.2)))
    np.testing.assert_allclose(saved.standing(here), here, atol=1e-12)
    x_m, y_m, _ = planar.from_transform(there @ askew)
    stood = saved.standing(there @ askew)
    np.testing.assert_allclose(stood[:3, 2], ramp[:3, 2], atol=1e-12)  # upright on the ramp
    np.testing.assert_allclose(stood[:2, 3], [x_m, y_m], atol=1e-12)
    assert stood[2, 3] == pytest.approx(2.0 + 0.1 * (10.0 - x_m), abs=0.01)


def test_a_base_that_is_mounted_askew_stands_askew_whichever_way_it_looks():
    pitched, back = se3.exp(PITCHED), se3.from_xy_yaw(4.0, 0.5, np.pi)
    nodes = [se3.from_xy_yaw(2.5 * k, 0.0, 0.0) @ pitched for k in range(3)]
    saved = replace(map_of(*[WALL] * 3), T_map_node=np.stack(nodes))
    drifted = back @ pitched @ se3.exp(np.array([0.0, 0.0, 0.0, 0.02, 0.03, 0.0]))
    np.testing.assert_allclose(saved.standing(drifted)[:3, 2], (back @ pitched)[:3, 2], atol=1e-3)


def test_a_base_that_is_mounted_askew_stands_askew_in_a_map_whose_frame_is_its_first_pose():
    askew, ahead = se3.exp(1.4 * PITCHED), se3.from_xy_yaw(2.5, 0.0, 0.0)
    corner = ahead @ se3.from_xy_yaw(0.0, 0.0, 2 * np.pi / 3)
    steps = [np.eye(4), *[ahead, ahead, corner] * 3, ahead]  # a triangle, and a part of it again
    flat = np.array(list(accumulate(steps, np.matmul)))
    nodes = se3.inverse(askew) @ flat @ askew
    saved = replace(map_of(*[WALL] * len(nodes)), T_map_node=nodes)
    here = se3.inverse(askew) @ se3.from_xy_yaw(1.0, 0.5, np.pi) @ askew
    drifted = here @ se3.exp(np.array([0.0, 0.0, 0.0, 0.02, 0.03, 0.0]))
    assert se3.rotation_angle_rad(se3.inverse(here) @ saved.standing(drifted)) < 0.02
    for node, T_plane in zip(nodes, map(planar.to_transform, saved.plane), strict=True):
        assert se3.rotation_angle_rad(se3.inverse(node) @ saved.standing(T_plane)) < 2e-3


def test_above_a_long_ramp_a_robot_stands_level_whichever_way_it_looks():
    ahead, turn = se3.from_xy_yaw(2.5, 0.0, 0.0), se3.from_xy_yaw(0.0, 0.0, np.pi / 2)
    up, level = se3.exp(-PITCHED), se3.exp(PITCHED)
    steps = [up, *[ahead] * 12, ahead @ level, *[ahead @ turn, ahead] * 4]
    nodes = np.array(list(accumulate(steps, np.matmul)))
    saved = replace(map_of(*[WALL] * len(nodes)), T_map_node=nodes)
    back = nodes[13] @ se3.from_xy_yaw(0.5, 0.0, np.pi)
    np.testing.assert_allclose(saved.standing(back), back, atol=1e-9)


@pytest.mark.parametrize(("is_known", "within_rad"), [(True, 1e-6), (False, 0.08)])
def test_a_robot_stands_level_in_a_map_that_was_made_by_hand(is_known, within_rad):
    """Submaps, and the map with its first, begin tilted by up to 12 degrees, and at any height."""
    rng, count = np.random.default_rng(0), 40
    ring = [se3.from_xy_yaw(12 * np.sin(k / 5), 12 * np.cos(k / 5), -k / 5) for k in range(count)]
    off = rng.uniform(-1.0, 1.0, (count, 6)) * [0.0, 0.0, 0.1, 0.15, 0.15, 0.0]
    held = np.array([T @ se3.exp(each) for T, each in zip(ring, off, strict=True)])
    T_map_level = se3.inverse(held[0])
    nodes = T_map_level @ held
    motions = [
        replace(edge(k, k + 1), T_first_second=se3.inverse(nodes[k]) @ nodes[k + 1])
        for k in range(count - 1)
    ]
    saved = replace(map_of(*[WALL] * count, edges=motions), T_map_node=nodes)
    ups = held[:, 2, :3] if is_known else [None] * count
    submaps = [replace(one, up=up) for one, up in zip(saved.submaps, ups, strict=True)]
    saved = replace(saved, submaps=tuple(submaps))
    for here in (T_map_level @ T for T in ring):
        stood = saved.standing(here)
        assert np.linalg.norm(stood[:3, 2] - T_map_level[:3, 2]) < within_rad
        np.testing.assert_allclose(stood[:2, 3], here[:2, 3], atol=1e-12)


# What is covered.


@pytest.mark.parametrize(
    ("walls", "away_m", "pieces", "is_covered"),
    [
        (40, 0.09, [0, 0], True),
        (40, -0.09, [0, 0], True),
        (40, 0.11, [0, 0], False),
        (37, 0.0, [0, 0], True),  # one is beside it: 95 %
        (36, 0.0, [0, 0], False),
        (40, 0.0, [0, 1], False),
    ],
)
def test_a_submap_is_removed_if_later_ones_of_its_piece_cover_its_walls(
    walls, away_m, pieces, is_covered
):
    later = plan_of("#" * walls)
    nodes = [[1.0, 2.0, 0.5], planar.compose(np.array([1.0, 2.0, 0.5]), np.array([0, away_m, 0]))]
    saved = map_of(WALL, later, nodes=nodes, pieces=pieces, edges=[edge(0, 1)])
    thinned = prune(saved)
    assert len(thinned.submaps) == 1 + (not is_covered)
    assert thinned.submaps[-1].plan is later and len(thinned.edges) == (not is_covered)


def test_a_submap_without_later_walls_stays_and_one_without_walls_goes():
    empty = join([])
    assert len(prune(map_of(WALL, empty)).submaps) == 2
    assert len(prune(map_of(empty, WALL)).submaps) == 1
    assert len(prune(map_of(WALL, WALL, nodes=[[0, 0, 0], [4.0, 0, 0]])).submaps) == 2
    assert len(prune(map_of(WALL, WALL, WALL)).submaps) == 1


@pytest.mark.parametrize(("later", "is_covered"), [(9, False), (39, True)])
def test_a_submap_stays_that_shows_free_space_beyond_later_ones(later, is_covered):
    """Cells within 0.2 m of a wall are known anyhow."""
    rows = [["." * free] * 20 + ["#" * 40] for free in (40, later)]
    first, second = (plan_of(*(row.ljust(40) for row in part)) for part in rows)
    assert len(prune(map_of(first, second)).submaps) == 1 + (not is_covered)


def test_a_submap_of_free_space_alone_goes_if_a_later_one_shows_it():
    """As one whose walls were contradicted."""
    hall, room = plan_of(*["." * 40] * 20), plan_of(*["." * 20] * 20)
    assert len(prune(map_of(hall, hall)).submaps) == 1
    assert len(prune(map_of(hall, room)).submaps) == 2
    assert len(prune(map_of(WALL, hall)).submaps) == 2


def test_motions_and_loops_through_removed_submaps_are_composed():
    far = [50.0 * index for index in range(4)]
    nodes = [[far[0], 0, 0], [far[1], 0, 0], [far[2], 0, 0], [far[1], 0, 0]]
    edges = [edge(0, 1), edge(1, 2), edge(2, 3), edge(0, 2, kind=EdgeKind.LOOP)]
    edges.append(edge(1, 3, kind=EdgeKind.LOOP))
    thinned = prune(map_of(WALL, WALL, WALL, WALL, nodes=nodes, edges=edges))
    found = [(one.first, one.second, one.kind) for one in thinned.edges]
    motion, loop = EdgeKind.MOTION, EdgeKind.LOOP
    assert found == [(1, 2, motion), (0, 1, loop), (0, 1, motion)]
    np.testing.assert_allclose(thinned.edges[2].T_first_second[:3, 3], [2.0, 0.0, 0.0])
    np.testing.assert_array_equal(thinned.plane[:, 0], [far[0], far[2], far[1]])


@pytest.mark.parametrize("seed", range(20))
def test_what_was_connected_stays_so_whatever_is_removed(seed):
    """Half of the submaps lie where later ones do; edges are a random tree, and some loops."""
    rng = np.random.default_rng(seed)
    nodes = [[50.0 * (index % 5), 0, 0] for index in range(10)]
    ends = [(int(rng.integers(index)), index) for index in range(1, 10)]
    edges = [edge(*pair, kind=KINDS[rng.integers(2)]) for pair in ends]
    edges += [edge(*sorted(rng.choice(10, 2, False).tolist()), kind=LOOP) for _ in range(4)]
    for number, one in enumerate(edges):
        motion = planar.between(np.array(nodes[one.first]), np.array(nodes[one.second]))
        edges[number] = replace(one, T_first_second=planar.to_transform(motion))
    thinned = prune(map_of(*[WALL] * 10, nodes=nodes, edges=edges))
    assert len(thinned.submaps) == 5 and flaws(thinned) == []


@pytest.mark.parametrize("has_tie", [False, True])
def test_loops_through_a_removed_submap_measure_though_nothing_measured_the_way_to_it(has_tie):
    """Submap 5 is a piece of its own, which loops join with those before and after."""
    nodes = np.array([[5.0 * index, 0, 0] for index in range(10)])
    pairs = [(row, row + 1) for row in range(9)] + [(2, 5), (3, 5), (5, 7), (5, 8)]
    edges = [
        edge(*pair, planar.between(*nodes[list(pair)]), kind=LOOP if row > 8 else EdgeKind.MOTION)
        for row, pair in enumerate([*pairs, (3, 7)])
    ]
    for row in (4, 5, 13):  # ties
        edges[row] = replace(edges[row], covariance=1e4 * np.eye(6), kind=EdgeKind.HANDOVER)
    plans = [WALL] * 5 + [join([])] + [WALL] * 4
    thinned = prune(map_of(*plans, nodes=nodes, edges=edges if has_tie else edges[:-1]))
    assert len(thinned.submaps) == 9
    measured = [one for one in thinned.edges if one.covariance[0, 0] < 1.0]
    across = [one for one in measured if one.first < 5 <= one.second]
    ends = sorted((one.first, one.second, one.kind) for one in across)
    assert ends == [(2, 6, LOOP), (3, 6, LOOP)]
    assert len(connected(range(9), measured)) == 1 and flaws(thinned) == []


# What is joined.


class Found(Recognizer):
    """A recognizer of pieces that finds each plan where it is told."""

    def __init__(self, monkeypatch, answers):
        self.answers, self.queries = list(answers), []
        monkeypatch.setattr(Recognizer, "of", lambda plan: self if len(plan) else None)

    def recognize(self, query, window):
        assert window is None
        self.queries.append(query.plan)
        answer = self.answers.pop(0)
        return answer and replace(answer, covariance=np.diag([1e-4, 1e-4, 1e-6]))


def two_pieces():
    """Two submaps 10 m apart, and a piece of three that are 1 m apart."""
    nodes = [[0, 0, 0], [10, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0]]
    plans = [WALL, WALL, plan_of("#"), plan_of("#"), plan_of("#")]
    edges = [edge(0, 1, (10, 0, 0)), edge(2, 3), edge(3, 4)]
    return map_of(*plans, nodes=nodes, pieces=[0, 0, 1, 1, 1], runs=[0, 0, 1, 1, 1], edges=edges)


def at(x_m, y_m, weak=0):
    return quality(at=(x_m, y_m, np.pi / 2), weak=weak)


def test_a_piece_is_joined_where_two_of_its_submaps_agree(monkeypatch):
    saved, found = two_pieces(), Found(monkeypatch, [at(9.0, 5.0), None, at(9.0, 7.0)])
    joined = join_pieces(saved)
    assert joined.apart == 0
    assert joined.pieces.tolist() == [0] * 5
    half = np.pi / 2
    expected = [[0, 0, 0], [10, 0, 0], [9, 5, half], [9, 6, half], [9, 7, half]]
    np.testing.assert_allclose(joined.plane, expected, atol=1e-6)
    loops = joined.edges[3:]
    assert [(loop.first, loop.second, loop.kind) for loop in loops] == [
        (1, 2, EdgeKind.LOOP), (1, 4, EdgeKind.LOOP)
    ]  # fmt: skip
    lies = planar.from_transform(loops[0].T_first_second)
    np.testing.assert_allclose(lies, [-1.0, 5.0, half], atol=1e-6)
    around = [np.rint(np.sort(plan.points[:, 0])).tolist() for plan in found.queries]
    assert around == [[0, 1], [-1, 0, 1], [-1, 0]]


def carried(T_map_node, tilt_rad, rng):
    """The nodes (N, 4, 4) as a hand carries base: tilted by up to this, and at any height."""
    off = tilt_rad * rng.uniform(-1.0, 1.0, (len(T_map_node), 6)) * [0.0, 0.0, 1.0, 1.0, 1.0, 0.0]
    return np.array([T @ se3.exp(each) for T, each in zip(T_map_node, off, strict=True)])


@pytest.mark.parametrize("is_held", [(True, True), (True, False), (False, True), (False, False)])
def test_a_piece_that_was_carried_by_hand_keeps_its_tilt_where_it_is_joined(monkeypatch, is_held):
    """A round each, of base that was held or moved on a floor; both frames begin with a pose."""
    rng, count = np.random.default_rng(0), 10
    rounds = []
    for held in is_held:
        flat = transforms([[4.0 * np.sin(k), -4.0 * np.cos(k), k] for k in np.arange(count)])
        rounds.append(carried(flat, 0.15 * held, rng))
    nodes = np.concatenate([se3.inverse(each[0]) @ each for each in rounds])
    steps = [(k, k + 1) for k in range(2 * count - 1) if k != count - 1]
    motions = [
        replace(edge(a, b), T_first_second=se3.inverse(nodes[a]) @ nodes[b]) for a, b in steps
    ]
    saved = map_of(*[WALL] * 2 * count, pieces=np.repeat([0, 1], count), edges=motions)
    ups = np.concatenate(rounds)[:, 2, :3]
    submaps = tuple(replace(one, up=up) for one, up in zip(saved.submaps, ups, strict=True))
    due = np.linalg.inv(rounds[0][0]) @ np.concatenate(rounds)
    lies = planar.from_transforms(due[count:])
    Found(monkeypatch, [quality(at=at) for at in lies])
    joined = join_pieces(replace(saved, submaps=submaps, T_map_node=nodes))
    loops = [loop for loop in joined.edges if loop.is_loop]
    assert joined.apart == 0 and len(loops) >= 9
    tilts_rad = [
        se3.log(se3.inverse(due[one.second]) @ due[one.first] @ one.T_first_second)[3:5]
        for one in loops
    ]
    assert np.abs(tilts_rad).max() < 0.004


@pytest.mark.parametrize(
    ("loops", "middle_m"), [([], 3.8), ([edge(0, 1, (3.5, 0.0, 0.0), kind=EdgeKind.LOOP)], 3.5)]
)
def test_a_piece_straightens_the_one_that_it_is_joined_to(monkeypatch, loops, middle_m):
    rough = [edge(0, 1, (4.0, 0.0, 0.0)), edge(1, 2, (6.0, 0.0, 0.0))]
    rough = [replace(one, covariance=0.04 * np.eye(6)) for one in rough]
    saved = map_of(
        *[WALL] * 5,
        nodes=[[0, 0, 0], [4, 0, 0], [10, 0, 0], [0, 0, 0], [9.6, 0, 0]],
        pieces=[0, 0, 0, 1, 1],
        runs=[0, 0, 0, 1, 1],
        edges=[*rough, edge(3, 4, (9.6, 0.0, 0.0)), *loops],
    )
    Found(monkeypatch, [quality(at=(x_m, 0.0, 0.0), weak=0) for x_m in (0.0, 10.0)])
    along = join_pieces(saved).plane[:, 0]
    np.testing.assert_allclose(along, [0.0, middle_m, 9.6, 0.0, 9.6], atol=0.02)


@pytest.mark.parametrize(("is_known", "pitch_rad"), [(True, 0.02), (False, 0.0)])
def test_pieces_that_are_joined_stand_as_was_measured(monkeypatch, is_known, pitch_rad):
    saved, found = two_pieces(), [at(9.0, 5.0), None, at(9.0, 7.0)]
    ups = [se3.exp(np.array([0, 0, 0, 0, -pitch, 0]))[:3, 2] for pitch in (0, 0, 0, 0, 0.03)]
    known = [is_known, is_known, True, True, True]
    submaps = [
        replace(submap, up=up if is_up else None)
        for submap, up, is_up in zip(saved.submaps, ups, known, strict=True)
    ]
    Found(monkeypatch, found)
    nodes = join_pieces(replace(saved, submaps=tuple(submaps))).T_map_node
    assert abs(-nodes[4, 2, 0] - pitch_rad) < 0.011


def test_a_loop_that_no_longer_fits_is_left_out():
    wrong = edge(0, 1, (5.0, 0.0, 0.0), kind=EdgeKind.LOOP)
    edges = [edge(0, 1), edge(0, 1, (4.0, 0.0, 0.0)), edge(1, 2, kind=EdgeKind.LOOP), wrong]
    saved = map_of(*[WALL] * 3, nodes=[[0, 0, 0], [1, 0, 0], [2, 0, 0]], edges=edges)
    assert list(saved.without_misfits().edges) == edges[:3]


@pytest.mark.parametrize(("variance", "apart"), [(1e-6, 1), (0.04, 0)])
def test_a_piece_is_joined_that_its_own_path_may_have_bent(monkeypatch, variance, apart):
    saved = two_pieces()
    edges = [replace(one, covariance=variance * np.eye(6)) for one in saved.edges]
    Found(monkeypatch, [at(9.0, 5.0), None, at(9.0, 7.3)])
    assert join_pieces(replace(saved, edges=tuple(edges))).apart == apart


@pytest.mark.parametrize(
    "answers",
    [
        [at(9.0, 5.0), None, None],
        [at(9.0, 5.0), None, at(9.0, 7.0, weak=1)],
        [at(9.0, 5.0), None, at(9.0, 8.0)],  # they contradict each other
    ],
)
def test_a_piece_stays_apart_without_two_that_agree(monkeypatch, answers):
    saved, _ = two_pieces(), Found(monkeypatch, answers)
    joined = join_pieces(saved)
    assert joined.apart == 1
    assert joined.pieces.tolist() == [0, 0, 1, 1, 1] and joined.edges == saved.edges


def test_pieces_are_numbered_again_where_one_was_joined(monkeypatch):
    saved = replace(two_pieces(), pieces=np.array([0, 0, 3, 3, 5]))
    Found(monkeypatch, [at(9.0, 5.0), at(9.0, 6.0), None])
    joined = join_pieces(saved)
    assert joined.apart == 1 and joined.pieces.tolist() == [0, 0, 0, 0, 1]


def test_what_was_joined_is_looked_for_again(monkeypatch):
    """The first shows one submap of either piece: two agree when they are one piece."""
    saved = map_of(
        *[WALL] * 5,
        nodes=[[0, 0, 0], [10, 0, 0], [11, 0, 0], [0, 0, 0], [1, 0, 0]],
        pieces=[0, 1, 1, 2, 2],
        edges=[edge(1, 2), edge(3, 4)],
    )
    apart, each = [None] * 4, [at(9.0, 5.0), at(9.0, 6.0)]
    far = [quality(at=(x_m, 4.0, np.pi), weak=0) for x_m in (15.0, 14.0)]
    Found(monkeypatch, [*apart, *each, at(20.0, 5.0), at(20.0, 6.0), *far])
    joined = join_pieces(saved)
    assert joined.apart == 0 and joined.pieces.tolist() == [0] * 5


def test_pieces_are_joined_with_each_other_where_the_first_shows_neither(monkeypatch):
    saved = replace(two_pieces(), pieces=np.array([0, 2, 2, 7, 7]))
    Found(monkeypatch, [None] * 4 + [at(9.0, 5.0), at(9.0, 6.0)] + [None] * 4)
    joined = join_pieces(saved)
    assert joined.apart == 1 and joined.pieces.tolist() == [0, 1, 1, 1, 1]
    Found(monkeypatch, [None] * 9)
    joined = join_pieces(saved)
    assert joined.apart == 2 and joined.pieces.tolist() == [0, 1, 1, 2, 2]


def test_submaps_of_other_runs_are_no_neighbours(monkeypatch):
    saved, found = two_pieces(), Found(monkeypatch, [None] * 3)
    submaps = [*saved.submaps[:4], replace(saved.submaps[4], run=2)]
    join_pieces(replace(saved, submaps=tuple(submaps)))
    assert [len(plan) for plan in found.queries] == [2, 2, 1]


# Where it may be written, and what is too large.


@pytest.mark.parametrize("command", ["merge", "prune", "export"])
@pytest.mark.parametrize("name", ["map/out", "map/../map/out"])
def test_nothing_is_written_into_a_map(tmp_path, capsys, command, name):
    save_map_files(map_of(WALL), tmp_path / "map")
    assert main([command, str(tmp_path / "map"), "--out", str(tmp_path / name)]) == 2
    assert "a map is saved in a folder of its own" in capsys.readouterr().err
    save_map_files(map_of(WALL, WALL), tmp_path / "map")


def test_an_export_replaces_an_earlier_one_and_nothing_else(tmp_path, capsys):
    save_map_files(map_of(WALL), tmp_path / "map")
    command = ["export", str(tmp_path / "map"), "--out"]
    for _ in range(2):
        assert main([*command, str(tmp_path / "out")]) == 0
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "grid.yaml").write_text("mine")
    assert main([*command, str(tmp_path / "mine")]) == 2
    assert "files that no run wrote: grid.yaml" in capsys.readouterr().err
    assert (tmp_path / "mine" / "grid.yaml").read_text() == "mine"


@pytest.mark.parametrize("again", ["map", "copy", "extended", "pruned"])
@pytest.mark.parametrize("is_first", [False, True])
def test_measurements_are_merged_once(tmp_path, capsys, again, is_first):
    """Other maps may hold the same: a copy, one that a run loaded and saved, or what is left."""
    saved = map_of(WALL, WALL)
    walls = (plan_of("#"), WALL, WALL)  # as `mode=update` forgets some, and a run is added
    others = {"copy": saved, "extended": map_of(*walls, runs=[0, 0, 1]), "pruned": saved.of([1])}
    for name, one in ({"map": saved} | others).items():
        save_map_files(one, tmp_path / name)
    names = [again, "map"] if is_first else ["map", again]
    first, second, out = (str(tmp_path / name) for name in (*names, "out"))
    assert main(["merge", first, second, "--out", out]) == 2
    assert f"one before has submaps of this map: {second}" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_maps_of_runs_that_begin_alike_are_merged(tmp_path):
    """In the simulator all runs begin with the stamp 0: a submap of one pose may be of any."""
    for name, run_ns in (("first", 0), ("second", S // 2)):
        saved = map_of(WALL, WALL)
        begun, later = saved.submaps
        begun = replace(begun, stamps_ns=np.zeros(1, np.int64), T_submap_base=np.zeros((1, 3)))
        later = replace(later, stamps_ns=later.stamps_ns + run_ns)
        save_map_files(replace(saved, submaps=(begun, later)), tmp_path / name)
    first, second, out = (str(tmp_path / name) for name in ("first", "second", "out"))
    assert main(["merge", first, second, "--out", out]) != 2


def test_a_piece_is_as_large_as_what_is_known_of_it():
    shown = plan_of(*["." * 40] * 20)
    line = described(map_of(shown, empty(), pieces=[0, 1]))
    assert "2.0 m x 1.0 m, free: 2.0 m2" in line[1] and "0.0 m x 0.0 m" in line[2]


def test_an_export_says_which_pieces_it_leaves_out(tmp_path, capsys):
    save_map_files(map_of(WALL, WALL, WALL, pieces=[0, 1, 2]), tmp_path / "map")
    assert main(["export", str(tmp_path / "map"), "--out", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == "error: pieces beside the first, which are not exported: 2\n"
    assert (tmp_path / "out" / "grid.yaml").exists()


def test_an_export_has_a_file_of_rising_stamps_for_each_run(tmp_path):
    nodes = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    both = side_by_side(map_of(WALL, WALL, nodes=nodes[:2]), map_of(WALL, nodes=nodes[2:]))
    save_map_files(replace(both, pieces=np.zeros(3, np.int64)), tmp_path / "map")
    out = tmp_path / "out"
    assert main(["export", str(tmp_path / "map"), "--out", str(out)]) == 0
    rows = [np.loadtxt(out / f"run_{run}.tum", ndmin=2)[:, :2].tolist() for run in (0, 1)]
    assert rows == [[[0.0, 0.0], [1.0, 1.0]], [[0.0, 2.0]]]
    save_map_files(map_of(WALL), tmp_path / "one")
    assert main(["export", str(tmp_path / "one"), "--out", str(out)]) == 0
    assert not (out / "run_1.tum").exists()


def test_an_empty_map_leaves_out_no_piece(tmp_path, capsys):
    save_map_files(empty_map(), tmp_path / "map")
    assert main(["merge", str(tmp_path / "map"), "--out", str(tmp_path / "out")]) == 0
    assert main(["export", str(tmp_path / "map"), "--out", str(tmp_path / "exported")]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("command", ["info", "export", "merge"])
def test_a_map_that_is_too_large_to_draw_is_named(tmp_path, capsys, command):
    folder = str(tmp_path / "map")
    save_map_files(map_of(WALL, WALL, nodes=[[0, 0, 0], [400, 400, 0]]), tmp_path / "map")
    out = [] if command == "info" else ["--out", str(tmp_path / "out")]
    assert main([command, folder, *out]) == 2
    assert capsys.readouterr().err.startswith("error: a floor plan of 403 m x 401 m, allowed")
    assert not (tmp_path / "out").exists()
