"""Which submaps' plans are compared to close a loop, with what, and where."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from planar_poses import transforms
from test_atlas_maps import Found, carried, edge, map_of
from test_atlas_places import CELL, plan_of, quality

from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.places.floor_plan import join
from sceneslam.atlas.submaps import plan_loops
from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.loop_query import LoopQuery
from sceneslam.atlas.submaps.piece_loops import PieceLoops
from sceneslam.atlas.submaps.plan_loops import PlanLoops
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.atlas.submaps.submap import Drawing, Submap
from sceneslam.graphs.edge import EdgeKind
from sceneslam.types import planar, se3
from sceneslam.types.covariance import unknown_motion

WALL = plan_of("##")
EMPTY = join([])


class Compared:
    """A recognizer that finds every plan at `off` (3,) from where it is expected."""

    off = np.zeros(3)
    found = True

    def __init__(self, monkeypatch):
        self.targets, self.windows, self.known_min = [], [], None
        monkeypatch.setattr(plan_loops, "Recognizer", self._of)

    def _of(self, field):
        self.targets.append(field.plan)
        return self

    def recognize(self, query, window, *, known_min):
        self.windows.append(window)
        self.query, self.known_min = query, known_min
        at = planar.compose(window.around, self.off)
        return quality(at=at) if self.found else None


def submap(session, plan=WALL, run=0):
    return Submap(
        run=run,
        session=session,
        module="a",
        stamps_ns=np.zeros(1, np.int64),
        T_submap_base=np.zeros((1, 3)),
        drawing=Drawing(plan),
    )


def finder_of(closed):
    """What a run compares plans with, in these sessions modules close loops."""
    return PlanLoops(RunGraph(empty_map(), lambda session: session in closed)._may_close)


def loops_to(second, sessions, nodes, sigma, *, closed=(), plans=None, runs=None):
    """Find loops between submaps at nodes, with drift of `sigma` (3,) from one to the next."""
    plans, runs = plans or [WALL] * len(sessions), runs or [0] * len(sessions)
    submaps = [submap(*one) for one in zip(sessions, plans, runs, strict=True)]
    drift = np.arange(len(sessions))[:, None] * np.array(sigma)
    return finder_of(closed).loops_to(query_of(second, submaps, transforms(nodes), drift))


def query_of(second, submaps, T_run_node, drift):
    """The query for a submap, with nodes (N, 4, 4) and the drift (N, 3) of wheels up to each."""
    drift = list(np.stack([drift, np.zeros_like(drift)], axis=1))[: len(submaps)]
    return LoopQuery.of(
        Chain(submaps=submaps, T_run_node=T_run_node[: len(submaps)], drift=drift), second
    )


def line(*x_m):
    return [[x, 0.0, 0.0] for x in x_m]


def firsts(*args, **settings):
    return [loop.first for loop in loops_to(*args, **settings)]


SMALL = (0.1, 0.1, 0.01)


def test_loops_are_searched_within_three_deviations_of_the_drift_between_their_ends(monkeypatch):
    compared = Compared(monkeypatch)
    nodes = [[2.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0], [2.0, 1.0, 0.5]]
    (loop,) = loops_to(2, [0, 0, 1], nodes, [0.2, 0.3, 0.1])
    (window,) = compared.windows
    np.testing.assert_allclose(window.around, [1.0, 0.0, 0.5 - np.pi / 2], atol=1e-12)
    assert window.half_m == pytest.approx(3.0 * np.hypot(0.6, 0.5 * 0.2 * 1.0))
    assert window.half_rad == pytest.approx(3.0 * 0.2)
    assert (loop.first, loop.second, loop.kind) == (0, 2, EdgeKind.LOOP)
    np.testing.assert_allclose(
        planar.from_transform(loop.T_first_second), window.around, atol=1e-12
    )
    assert compared.known_min == 0.35
    loops_to(2, [0, 0, 1], nodes, [0.3, 0.2, 0.1])
    assert compared.windows[-1].half_m == pytest.approx(window.half_m)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_loop_that_is_found_outside_its_window_is_left_out(monkeypatch, axis):
    compared = Compared(monkeypatch)
    half = 0.6 if axis < 2 else 0.06
    for sign in (1.0, -1.0):
        for share in (0.99, 1.01):
            compared.off = sign * share * half * np.eye(3)[axis]
            assert len(firsts(2, [0, 0, 1], line(0, 0, 0), SMALL)) == (share < 1.0)
    compared.found = False
    assert firsts(2, [0, 0, 1], line(0, 0, 0), SMALL) == []


@pytest.mark.parametrize(
    ("climbed_m", "sigma_m", "is_found"),
    [(0.6, 0.1, True), (1.1, 0.1, True), (3.0, 0.1, False), (-3.0, 0.1, False), (3.0, 0.6, True)],
)
@pytest.mark.parametrize("pitch_rad", [0.0, 0.2])
def test_no_plans_of_another_storey_are_compared(
    monkeypatch, climbed_m, sigma_m, is_found, pitch_rad
):
    """Base is pitched against the floor, and so is the run's frame."""
    Compared(monkeypatch)
    nodes = transforms(line(0, 5, 0))
    nodes[2, 2, 3] = climbed_m
    T_level_base = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, pitch_rad, 0.0]))
    nodes = se3.inverse(T_level_base) @ nodes @ T_level_base
    up_base = T_level_base[2, :3]
    submaps = [replace(submap(session), up=up_base) for session in (0, 0, 1)]
    drift = np.arange(3)[:, None] * [sigma_m, sigma_m, 0.01]
    query = query_of(2, submaps, nodes, drift)
    assert (0 in [loop.first for loop in finder_of(()).loops_to(query)]) == is_found


def test_no_plans_are_compared_where_the_heading_may_be_off_by_more_than_a_right_angle(monkeypatch):
    Compared(monkeypatch)
    for share in (0.999, 1.001):
        sigma = [0.1, 0.1, share * np.pi / 2 / 3.0 / 2.0]  # three deviations over two motions
        assert firsts(2, [0, 0, 1], line(0, 0, 0), sigma) == ([0] if share < 1.0 else [])


def test_the_three_nearest_submaps_that_are_no_neighbours_are_compared(monkeypatch):
    Compared(monkeypatch)
    x_m = [0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0, 0.0, 0.0]
    assert firsts(11, [0] * 11 + [1], line(*x_m), SMALL) == [9, 6, 3]
    x_m[2] = 0.0
    assert firsts(11, [0] * 11 + [1], line(*x_m), SMALL) == [2, 9, 6]


def test_a_session_closes_loops_with_itself_unless_its_module_does(monkeypatch):
    Compared(monkeypatch)
    nodes = line(*[0] * 6)
    assert firsts(5, [0] * 6, nodes, SMALL) == [0]  # more than a target's width apart
    assert firsts(4, [0] * 6, nodes, SMALL) == []
    assert firsts(5, [0] * 6, nodes, SMALL, closed=[0]) == []
    assert firsts(5, [0, 0, 1, 1, 1, 1], nodes, SMALL, closed=[1]) == [0]
    assert firsts(5, [0] * 6, nodes, SMALL, closed=[0], runs=[0, 0, 0, 0, 1, 1]) == [0, 3]
    assert firsts(1, [0, 1], nodes, SMALL) == []  # the motion between them was measured
    assert firsts(2, [0, 0, 1], nodes, SMALL, closed=[0, 1]) == [0]
    for without in (0, 5):
        plans = [EMPTY if index == without else WALL for index in range(6)]
        assert firsts(5, [0] * 6, nodes, SMALL, plans=plans) == []
        assert 0 not in firsts(5, [0, 0, 0, 0, 0, 1], nodes, SMALL, plans=plans)


def test_submaps_are_compared_if_they_may_overlap_and_it_may_improve_them(monkeypatch):
    Compared(monkeypatch)

    def is_compared(x_m, y_m, sigma_m):
        nodes = [[0, 0, 0], [90, 90, 0], [x_m, y_m, 0]]
        return firsts(2, [0, 0, 1], nodes, [sigma_m / 2, sigma_m / 2, 0.0]) == [0]

    for sign in (1.0, -1.0):
        reach_m = 3.0 * 0.5 + CELL  # from the wall's farther point
        assert is_compared(sign * (reach_m - 0.01), 0.0, 0.5)
        assert not is_compared(sign * (reach_m + 0.01), 0.0, 0.5)
        assert is_compared(0.0, sign * 1.49, 0.5) and not is_compared(0.0, sign * 1.51, 0.5)
    assert is_compared(0.0, 0.0, 0.021) and not is_compared(0.0, 0.0, 0.019)


def test_a_target_is_the_plan_of_two_neighbours_on_either_side_in_one_session(monkeypatch):
    compared = Compared(monkeypatch)

    def around(second, sessions, runs=None):
        """Return the first target's node, and whose walls it has; nodes are 0.2 m apart."""
        nodes = [[0.0, 0.2 * index, 1.0] for index in range(len(sessions))]
        first, *_ = firsts(second, sessions, nodes, SMALL, plans=[plan_of("#")] * 8, runs=runs)
        walls = [planar.apply(np.array(nodes[first]), compared.targets[0].points)]
        compared.targets.clear()
        own = planar.apply(np.array(nodes[0]), plan_of("#").points.astype(np.float64))
        return first, sorted(np.rint((walls[0] - own)[:, 1] / 0.2).astype(int).tolist())

    assert around(7, [0] * 7 + [1]) == (5, [3, 4, 5, 6])
    assert around(7, [0] * 5 + [2, 2, 1]) == (5, [5, 6])
    assert around(7, [0] * 4 + [2, 2, 1, 1]) == (5, [4, 5])
    assert around(7, [0] * 8) == (2, [0, 1, 2, 3, 4])
    assert around(7, [0] * 8, runs=[0, 1, 1, 1, 1, 1, 1, 1]) == (2, [1, 2, 3, 4])
    assert around(4, [0] * 4 + [1] * 4) == (2, [0, 1, 2, 3])


def test_a_submap_at_a_pose_that_jumped_is_in_no_target(monkeypatch):
    compared, nodes = Compared(monkeypatch), line(*[0.0] * 7)
    nodes[3] = [600.0, 600.0, 0.0]
    assert firsts(6, [0] * 6 + [1], nodes, SMALL) == [0, 4]
    shapes = {plan.free.shape for plan in compared.targets}
    assert shapes == {join([(np.zeros(3), WALL)]).free.shape}


def test_a_target_is_made_once_for_all_that_are_compared_with_it(monkeypatch):
    compared = Compared(monkeypatch)
    sessions = [0] * 4 + [1] * 16
    submaps = [submap(session) for session in sessions]
    finder, nodes = finder_of([1]), transforms(np.zeros((20, 3)))
    drift = 0.1 * np.outer(sessions, np.ones(3))
    for second in range(6, 20):
        assert len(finder.loops_to(query_of(second, submaps, nodes, drift))) == 2
    assert len(compared.targets) == 2
    for count, made in ((6, 0), (5, 1), (2, 2)):  # of 0 to 2, and of 1 to 5
        compared.targets.clear()
        finder.forget(count)
        assert len(finder.loops_to(query_of(19, submaps, nodes, drift))) == 2
        assert len(compared.targets) == made


def query_along(nodes, starts=()):
    """The query for the last node of a run that measured the motions but those to `starts`."""
    steps = [se3.inverse(a) @ b for a, b in pairwise(nodes)]
    motions = [replace(edge(k, k + 1), T_first_second=step) for k, step in enumerate(steps)]
    for start in starts:
        seam, unknown = motions[start - 1], unknown_motion(10.0)
        motions[start - 1] = replace(seam, kind=EdgeKind.HANDOVER, covariance=unknown)
    chain = Chain(
        submaps=[submap(0)] * len(nodes),
        T_run_node=nodes,
        motions=motions,
        drift=list(0.1 * np.arange(len(nodes))[:, None, None] * [[1.0, 1.0, 0.1], [0.0] * 3]),
    )
    return LoopQuery.of(chain, len(nodes) - 1)


@pytest.mark.parametrize(("tilt_rad", "is_on_floor"), [(0.0, True), (0.15, False)])
def test_a_loop_by_plans_has_the_tilt_of_a_sensor_that_is_carried_by_hand(tilt_rad, is_on_floor):
    rng, count = np.random.default_rng(0), 12
    flat = transforms([[2.0 * np.cos(k), 2.0 * np.sin(k), k] for k in range(count)])
    tilts = tilt_rad * rng.uniform(-1.0, 1.0, (count, 6)) * [0.0, 0.0, 0.3, 1.0, 1.0, 0.0]
    nodes = [T @ se3.exp(tilt) for T, tilt in zip(flat, tilts, strict=True)]
    query = query_along(nodes)
    found = query.on_plane(2, planar.between(query.plane[2], query.plane[-1]))
    assert (query.floor_normal is not None) == is_on_floor
    np.testing.assert_allclose(found, se3.inverse(nodes[2]) @ nodes[-1], atol=1e-9)


def test_plans_tell_height_and_tilt_on_a_floor_and_neither_by_hand(monkeypatch):
    pitch, roll = np.array([0, 0, 0, 0, -0.1, 0.0]), np.array([0, 0, 0, 0.2, 0, 0.0])
    tilt = se3.exp(pitch) @ se3.exp(roll)  # keeps the yaw
    flat = [se3.from_xy_yaw(np.cos(k), np.sin(k), k) for k in range(8)]
    plane = np.diag([0.02, 0.03, 0.005]) ** 2
    level = planar.spatial_covariance(plane, level=np.array([0.05, 0.02, 0.02]) ** 2)
    np.testing.assert_allclose(query_along(flat).spatial(plane), level)
    held = query_along([*flat[::2], *(T @ tilt for T in flat[1::2])])
    along = se3.carried(held.spatial(plane), tilt)  # in axes that are level
    open_level = planar.spatial_covariance(plane, level=np.array([1.0, 0.3, 0.3]) ** 2)
    np.testing.assert_allclose(along, open_level, atol=1e-12)
    Compared(monkeypatch)
    loop, *_ = finder_of([]).loops_to(held)
    np.testing.assert_allclose(loop.covariance, held.spatial(quality().covariance))


@pytest.mark.parametrize("pitch_rad", [0.01, 0.02, 0.15])
@pytest.mark.parametrize("corners", [[0, 1, 2, 3], [0, 1, 1, 1, 1, 2, 3, 3, 3, 3]])
def test_a_loop_by_plans_closes_the_climb_of_a_base_that_is_mounted_askew(pitch_rad, corners):
    """Rounds of a rectangle by odometry that climbs 1 %, in the map that its first pose begins."""
    mount, step_m = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, pitch_rad, 0.0])), 2.0
    true, climbing = [np.eye(4)], [np.eye(4)]
    for corner in (corners * 3)[: 2 * len(corners) + 2]:
        yaw_rad = 0.5 * np.pi * corner - planar.from_transform(true[-1])[2]
        step = se3.from_xy_yaw(0.0, 0.0, yaw_rad) @ se3.from_xy_yaw(step_m, 0.0, 0.0)
        true.append(true[-1] @ step)
        step[2, 3] = 0.01 * step_m
        climbing.append(climbing[-1] @ step)
    T_map_level = se3.inverse(mount)
    query = query_along([T_map_level @ T @ mount for T in climbing])
    first = len(true) - 1 - len(corners)
    T_first_second = planar.between(query.plane[first], query.plane[-1])
    found = mount @ query.on_plane(first, T_first_second) @ T_map_level
    due = se3.inverse(true[first]) @ true[-1]
    off = se3.log(se3.inverse(due) @ found)
    assert np.abs(off[2]) < 2e-6  # the odometry is off by 0.08 and 0.2 m
    assert np.abs(off[3:5]).max() < 1e-9


@pytest.mark.parametrize(("axis", "askew_rad"), [(3, 0.03), (3, 0.1), (4, 0.1), (4, 0.3)])
@pytest.mark.parametrize("aside_rad", [0.0, 0.8])
def test_a_loop_by_plans_is_right_however_base_is_mounted(axis, askew_rad, aside_rad):
    """Along a corridor and back, in the map that its first pose begins."""
    mount = se3.exp(np.roll([askew_rad, 0, 0, 0, 0, 0], axis))
    there = [se3.from_xy_yaw(2.5 * k, 0.0, 0.0) for k in range(12)]
    back = [se3.from_xy_yaw(2.5 * k, 0.0, np.pi + aside_rad) for k in range(11, -1, -1)]
    nodes = [se3.inverse(mount) @ T @ mount for T in there + back]
    query = query_along(nodes)
    found = query.on_plane(1, planar.between(query.plane[1], query.plane[-1]))
    np.testing.assert_allclose(found, se3.inverse(nodes[1]) @ nodes[-1], atol=3e-3)


@pytest.mark.parametrize(("roll_rad", "pitch_rad"), [(0.17, 0.17), (0.03, 0.35), (-0.1, 0.1)])
def test_a_base_that_is_mounted_askew_in_two_axes_is_placed_as_its_plans_are(roll_rad, pitch_rad):
    roll, pitch = (
        se3.exp(np.roll([angle, 0, 0, 0, 0, 0], k)) for k, angle in ((3, roll_rad), (4, pitch_rad))
    )
    mount = pitch @ roll  # has no yaw
    nodes = [se3.from_xy_yaw(2 * np.sin(k), -2 * np.cos(k), k) @ mount for k in range(12)]
    query = query_along(nodes)
    found = query.on_plane(2, planar.between(query.plane[2], query.plane[-1]))
    np.testing.assert_allclose(found, se3.inverse(nodes[2]) @ nodes[-1], atol=1e-6)
    saved = replace(map_of(*[WALL] * 12, edges=query.motions), T_map_node=np.array(nodes))
    here = planar.to_transform(np.array([1.0, 0.5, 2.0]))
    np.testing.assert_allclose(saved.standing(here), here @ mount, atol=1e-6)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.15])
def test_a_loop_to_a_piece_has_the_tilt_of_a_sensor_that_is_carried_by_hand(monkeypatch, tilt_rad):
    count = 24
    flat = transforms([[2.0 * np.cos(k), 2.0 * np.sin(k), k] for k in np.arange(count) / 2])
    held = carried(flat, tilt_rad, np.random.default_rng(0))
    nodes = se3.inverse(held[0]) @ held  # the map begins with the first pose
    query = query_along(list(nodes), starts=[count // 2])
    ups = [replace(one, up=T[2, :3]) for one, T in zip(query.submaps, held, strict=True)]
    query = replace(query, submaps=ups)
    Found(monkeypatch, [quality(at=query.plane[-1])])
    (loop,) = PieceLoops().loops_to(query, nodes)
    assert loop.first < count // 2 and loop.second == count - 1
    off = se3.log(se3.inverse(nodes[-1]) @ nodes[loop.first] @ loop.T_first_second)
    assert np.abs(off[3:5]).max() < 0.003
    assert (np.sqrt(loop.covariance[2, 2]) > 0.5) == (tilt_rad > 0.0)
