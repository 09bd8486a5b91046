"""What the graph of a run is made of, and what its covariances are."""

import importlib
import pkgutil
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planar_poses import transforms
from test_atlas_limits import loop
from test_atlas_maps import WALL, map_of
from test_atlas_submaps import S, at, pitched, run_of

import sceneslam.atlas
from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.covariances import PosedPath, calibrated, covariances
from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.places.localizer import Fix
from sceneslam.atlas.submaps import run_graph
from sceneslam.atlas.submaps.graph import Agreement, Solved, consistent, settle
from sceneslam.atlas.submaps.run_graph import RunGraph, SolvedRun
from sceneslam.atlas.uncertainty import WHEELS
from sceneslam.types import planar, se3
from sceneslam.types.maps import MapLayers, PoseGraphLayer
from sceneslam.types.trajectory import Trajectory

CLAIM = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0]) * 1e-6


def there(x_m, y_m, yaw_rad=0.0):
    """A fix at a pose of the map."""
    pose = planar.to_transform(np.array([x_m, y_m, yaw_rad]))
    return {"T_map_base": pose, "covariance": planar.spatial_covariance(np.eye(3), level=1.0)}


class Given:
    """What the graph is solved with; every loop that is left is accepted."""

    def __init__(self, monkeypatch, *, agreeing=None, found=()):
        self.found, self.agreeing = found, agreeing
        monkeypatch.setattr(run_graph, "solve", self._solve)
        monkeypatch.setattr(run_graph, "PlanLoops", lambda may_close: self)
        monkeypatch.setattr(run_graph, "consistent", self._consistent)

    def loops_to(self, query):
        return [edge for edge in self.found if edge.second == query.second]

    def _consistent(self, loops, nodes, drift):
        self.measured, self.nodes, self.drift = loops, nodes, drift
        return list(range(len(loops))) if self.agreeing is None else self.agreeing

    def _solve(self, T_map_node, motions, loops, *, fixed, loose, uprights):
        self.motions, self.loops, self.uprights = motions, loops, uprights
        self.fixed, self.loose = list(fixed), loose
        return Solved(T_map_node=T_map_node, accepted=list(range(len(loops))))


def finished(count=18):
    """A run of so many steps of 0.5 m, one a second: six in a submap."""
    own = run_of(count)
    own.finish()
    return own


def solved(own, loaded=None, *, maps=(), fixes=(), T_map_run=None):
    """Solve, where a module revised all poses by 0.01 m to the left."""
    graph = RunGraph(loaded or empty_map(), lambda session: False)
    nodes = np.stack(own.chain.T_run_node)
    return graph.finish(
        own.chain,
        nodes if T_map_run is None else T_map_run @ nodes,
        lambda ns: at(0.5 * ns / S) @ at(0.0, 0.01),
        maps,
        fixes,
        is_level=own.is_level,
    )


def graph_of(pairs_s, T_from_to):
    """A module's pose graph with loops between these seconds."""
    seconds = sorted({second for pair in pairs_s for second in pair})
    return PoseGraphLayer(
        stamps_ns=np.array(seconds) * S,
        T_world_base=np.stack([at()] * len(seconds)),
        edges=np.array([[seconds.index(second) for second in pair] for pair in pairs_s]),
        T_from_to=np.stack(T_from_to),
        information=np.stack([np.eye(6) * 1e4] * len(pairs_s)),
        is_loop=np.ones(len(pairs_s), bool),
    )


def test_loops_of_modules_lead_from_submap_to_submap(monkeypatch):
    given, own = Given(monkeypatch), finished()
    loops = graph_of([(2, 14), (7, 8), (1, 7)], [at(5.0), at(), at(2.0, 1.0, 0.5)])
    solved(own, maps=[MapLayers(pose_graph=loops)])
    *steps, first, second = given.motions
    assert [(one.first, one.second) for one in steps] == [(0, 1), (1, 2)]  # (7, 8) is in one
    assert [(one.first, one.second) for one in (first, second)] == [(0, 2), (0, 1)]
    left = at(0.0, 0.01)  # nodes stay where they were, poses are revised
    expected = at(1.0) @ left @ at(5.0) @ se3.inverse(at(1.0) @ left)
    np.testing.assert_allclose(first.T_first_second, expected, atol=1e-12)
    T_to_node = se3.inverse(at(0.5) @ left)
    np.testing.assert_allclose(
        second.T_first_second, at(0.5) @ left @ at(2.0, 1.0, 0.5) @ T_to_node, atol=1e-12
    )
    carry = se3.adjoint(se3.inverse(T_to_node))
    np.testing.assert_allclose(second.covariance, carry @ (1.01e-4 * np.eye(6)) @ carry.T)


def test_loops_within_a_module_are_motions_of_the_graph(monkeypatch):
    given, own = Given(monkeypatch), finished()
    graph = graph_of([(1, 13)], [at(6.0)])
    solved(own, map_of(WALL), maps=[MapLayers(pose_graph=graph)])
    ends = [(one.first, one.second) for one in given.motions]
    assert ends == [(1, 2), (2, 3), (1, 3)] and given.loops == []
    assert (given.fixed, given.loose) == ([0], 1)


def test_one_loop_alone_is_not_believed_unless_the_run_was_located(monkeypatch):
    given, own = Given(monkeypatch, found=[loop(0, 2, [6, 0, 0])]), finished()
    assert solved(own).loops == () and given.loops == []
    given.found = [loop(0, 2, [6, 0, 0]), loop(0, 1, [3, 0, 0])]
    found = solved(own).loops
    assert [(one.first, one.second) for one in found] == [(0, 1), (0, 2)]
    given.agreeing = [1]
    assert solved(own).loops == ()
    fix = Fix(stamp_ns=S, **there(0.5, 0.0))
    (one,) = solved(own, map_of(WALL), fixes=[fix]).loops
    assert (one.first, one.second) == (1, 2)
    own._level = 0  # a base that does not move on a floor
    given.agreeing = None
    assert [edge.second for edge in solved(own, map_of(WALL), fixes=[fix]).loops] == [1]


def test_a_fix_leads_from_the_nearest_submap_of_the_loaded_piece(monkeypatch):
    given, own = Given(monkeypatch), finished()
    nodes = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.5], [4.2, 0.1, 0.0], [2.0, 3.0, 0.0]]
    loaded = map_of(*[WALL] * 4, nodes=nodes, pieces=[0, 0, 1, 0])
    fixes = [
        Fix(stamp_ns=1 * S, **there(0.5, 0.2)),
        Fix(stamp_ns=8 * S, **there(4.0, 0.0, 0.25)),
    ]
    solved(own, loaded, fixes=fixes)
    ends = [(edge.first, edge.second) for edge in given.measured]
    assert ends == [(0, 4), (1, 5)]
    T_base_node = planar.between(np.array([4.0, 0.01, 0.0]), np.array([3.0, 0.0, 0.0]))
    at_node = planar.compose(np.array([4.0, 0.0, 0.25]), T_base_node)
    due = planar.to_transform(planar.between(np.array(nodes[1]), at_node))
    np.testing.assert_allclose(given.measured[1].T_first_second, due, atol=1e-12)
    T_node_base = planar.between(T_base_node, np.zeros(3))
    at_node = planar.propagate(np.eye(3), np.zeros(3), T_base_node, np.zeros((3, 3)))
    assert T_node_base[0] == pytest.approx(1.0)
    measured = planar.planar_covariance(given.measured[1].covariance)
    np.testing.assert_allclose(measured, at_node, atol=1e-9)
    assert given.nodes.shape == (7, 4, 4) and (given.drift[:4] == 0).all()
    np.testing.assert_array_equal(given.drift[4:], own.chain.drift)


def test_fixes_of_one_submap_are_one_loop_their_mean(monkeypatch):
    given, own = Given(monkeypatch), finished()
    fixes = [Fix(stamp_ns=S, **there(0.5, y_m)) for y_m in (0.2, 0.4, 0.3)]
    solved(own, map_of(WALL), fixes=fixes)
    (mean,) = given.measured
    (alone,) = (solved(own, map_of(WALL), fixes=fixes[2:]), given.measured)[1]
    np.testing.assert_allclose(mean.T_first_second, alone.T_first_second, atol=1e-12)
    np.testing.assert_allclose(mean.covariance, alone.covariance, atol=1e-9)


def test_the_first_vertical_direction_gives_that_of_the_map(monkeypatch):
    given, own = Given(monkeypatch), finished()
    tilts = [0.02, 0.05, 0.06]
    own.chain.up_node = {node: pitched(0, 0, tilt)[2, :3] for node, tilt in enumerate(tilts)}
    own.chain.T_run_node[0] = pitched(0, 0, 0.1)
    solved(own, map_of(WALL))
    assert [one.node for one in given.uprights] == [1, 2, 3]
    for one, tilt in zip(given.uprights, tilts, strict=True):  # 0.05 is the sensor's own
        np.testing.assert_allclose(one.up_node, pitched(0, 0, tilt - 0.05)[2, :3], atol=1e-9)
        np.testing.assert_allclose(one.up_map, pitched(0, 0, -0.13)[2, :3], atol=1e-9)


@pytest.mark.parametrize("apart_m", [0.0, 3.0])
def test_headings_of_loops_agree_within_their_deviation(apart_m):
    nodes = np.array([[0, 0, 0], [0, 0, 0], [10, 0, 0], [10 + apart_m, 0, 0]], float)
    drift = np.zeros((4, 3))
    drift[3, 2] = 0.02
    bound = np.sqrt(16.81) * np.hypot(np.sqrt(2) * 0.01, 0.02)
    for sign in (1.0, -1.0):
        for share in (0.999, 1.001):
            second = loop(1, 3, [10 + apart_m, 0, sign * share * bound])
            both = consistent([second, loop(0, 2, [10, 0, 0])], transforms(nodes), drift)
            assert (len(both) == 2) == (share < 1.0)


# Loops that are found while the run goes on.


class Searched(Given):
    """Loops are found to the submaps that they lead to; the graph is solved in earnest."""

    name = "PlanLoops"

    def __init__(self, monkeypatch, found):
        self.found, self.asked, self.queries, self.kept, self.solved = found, [], {}, [], 0
        monkeypatch.setattr(run_graph, self.name, lambda may_close: self)
        monkeypatch.setattr(run_graph, "settle", self._settle)

    def loops_to(self, query):
        self.asked.append(query.second)
        self.queries[query.second] = query
        return super().loops_to(query)

    def forget(self, count):
        self.kept.append(count)

    def _settle(self, *given):
        self.solved += 1
        return settle(*given)


class Viewed(Searched):
    """The same, by views."""

    name = "ViewLoops"

    def loops_to(self, query):
        return super().loops_to(query), query.submap.views


def off(first, second, aside_m=0.02):
    """A loop between two nodes 3 m apart each, `aside_m` off where the motions lead."""
    return loop(first, second, [3.0 * (second - first), aside_m, 0.0], sigma=0.01)


def grown(own, count):
    chain = own.chain.copy()
    chain.cut(count)
    return chain


def test_loops_are_searched_once_to_each_submap_and_believed_when_two_agree(monkeypatch):
    searched, own = Searched(monkeypatch, [off(0, 5), off(0, 6)]), finished(48)
    graph = RunGraph(map_of(WALL, WALL), lambda session: False)
    alone = graph.extend(grown(own, 6), is_level=True)
    assert alone.loops == () and searched.solved == 0 and searched.asked == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(alone.T_map_node, own.chain.T_run_node[:6], atol=1e-12)
    both = graph.extend(grown(own, 7), is_level=True)
    assert [(one.first, one.second) for one in both.loops] == [(2, 7), (2, 8)]
    assert searched.asked[6:] == [6] and searched.solved == 1
    aside_m = both.T_map_node[:, 1, 3]
    assert aside_m[0] == pytest.approx(0.0, abs=1e-6) and 0.01 < aside_m[5] < 0.02
    after = graph.extend(own.chain, is_level=True)  # nothing is found to the eighth
    assert searched.asked[7:] == [7] and searched.solved == 1 and len(after.loops) == 2
    np.testing.assert_array_equal(after.T_map_node[:7], both.T_map_node)
    step = own.chain.motions[6].T_first_second
    np.testing.assert_allclose(after.T_map_node[7], both.T_map_node[6] @ step, atol=1e-12)


def test_plans_are_compared_once_the_base_is_level_and_views_on_any(monkeypatch):
    plans, views = Searched(monkeypatch, [off(0, 5), off(0, 6)]), Viewed(monkeypatch, [])
    own, graph = finished(48), RunGraph(empty_map(), lambda session: False)
    assert graph.extend(grown(own, 7), is_level=False).loops == ()
    assert plans.asked == [] and views.asked == list(range(7))
    assert len(graph.extend(own.chain, is_level=True).loops) == 2
    assert plans.asked == views.asked == list(range(8))
    last = views.queries[7]
    np.testing.assert_allclose(last.T_run_node, own.chain.T_run_node, atol=1e-12)
    np.testing.assert_allclose(plans.queries[7].plane, planar.from_transforms(last.T_run_node))
    for second in range(8):
        drift = views.queries[second].drift  # plans are searched when there are more submaps
        np.testing.assert_array_equal(plans.queries[second].drift[: len(drift)], drift)


def test_views_close_loops_on_a_base_that_is_never_level(monkeypatch):
    plans, views = Searched(monkeypatch, []), Viewed(monkeypatch, [off(0, 5), off(0, 6)])
    own, graph = finished(48), RunGraph(empty_map(), lambda session: False)
    assert len(graph.extend(own.chain, is_level=False).loops) == 2
    nodes = np.stack(own.chain.T_run_node)
    last = graph.finish(own.chain, nodes, lambda ns: at(0.5 * ns / S), [], [], is_level=False)
    assert len(last.loops) == 2 and plans.asked == [] and views.asked == list(range(8))
    graph.finish(own.chain, nodes, lambda ns: at(0.5 * ns / S), [], [], is_level=True)
    assert plans.asked == views.asked == list(range(8))


def test_a_loop_by_plans_and_one_by_views_are_believed_if_they_agree(monkeypatch):
    own = finished(48)
    for aside_m, accepted in ((0.02, [(0, 6), (0, 5)]), (0.9, [])):
        Searched(monkeypatch, [off(0, 5)]), Viewed(monkeypatch, [off(0, 6, aside_m)])
        found = RunGraph(empty_map(), lambda session: False).extend(own.chain, is_level=True)
        assert [(one.first, one.second) for one in found.loops] == accepted


def test_after_a_loop_places_are_searched_around_where_motions_alone_lead(monkeypatch):
    """Around a solution with a wrong loop those that agree with it would be found."""
    searched, own = Searched(monkeypatch, [off(0, 5), off(0, 6)]), finished(54)
    graph = RunGraph(empty_map(), lambda session: False)
    for count in (7, 9):
        found = graph.extend(grown(own, count), is_level=True)
    assert len(found.loops) == 2
    for second in (5, 8):
        query = searched.queries[second]
        np.testing.assert_array_equal(query.drift, own.chain.drift[: len(query.drift)])
    np.testing.assert_array_equal(query.plane[8], planar.from_transform(own.chain.T_run_node[8]))


def test_forgotten_submaps_take_their_loops_with_them_and_are_searched_again(monkeypatch):
    searched, own = Searched(monkeypatch, [off(0, 5), off(0, 6), off(0, 7)]), finished(48)
    views = Viewed(monkeypatch, [])
    graph = RunGraph(empty_map(), lambda session: False)
    assert len(graph.extend(own.chain, is_level=True).loops) == 3
    graph.forget(8)
    assert searched.kept == views.kept == []  # there are no others
    graph.forget(7)
    assert searched.kept == views.kept == [7]
    searched.found = searched.found[:2]
    again = graph.extend(own.chain, is_level=True)
    assert [(one.first, one.second) for one in again.loops] == [(0, 5), (0, 6)]
    assert searched.asked[8:] == views.asked[8:] == [7]
    fresh = RunGraph(empty_map(), lambda session: False).extend(own.chain, is_level=True)
    np.testing.assert_allclose(again.T_map_node, fresh.T_map_node, atol=1e-6)


def test_nodes_return_to_where_motions_lead_when_no_loop_is_left(monkeypatch):
    searched, own = Searched(monkeypatch, [off(0, 5), off(0, 6)]), finished(48)
    graph = RunGraph(empty_map(), lambda session: False)
    bent = graph.extend(own.chain, is_level=True).T_map_node
    assert np.abs(bent[:6, 1, 3]).max() > 0.01
    graph.forget(6)
    searched.found = []
    straight = graph.extend(own.chain, is_level=True)
    assert straight.loops == ()
    np.testing.assert_array_equal(straight.T_map_node, own.chain.T_run_node)


def test_a_solution_is_cut_with_its_loops():
    loops = tuple(loop(*ends, [1.0, 0.0, 0.0]) for ends in ((0, 4), (2, 5), (3, 6)))
    found = SolvedRun(T_map_node=np.tile(np.eye(4), (5, 1, 1)), loops=loops).cut(3, loaded=3)
    assert len(found.T_map_node) == 3 and found.loops == loops[:2]


_NODES = 12


@given(st.integers(0, 10**6), st.integers(0, _NODES))
def test_loops_that_are_compared_as_they_are_found_agree_as_all_at_once(seed, kept):
    rng = np.random.default_rng(seed)
    plane = np.cumsum(rng.normal(0.0, 1.0, (_NODES, 3)), axis=0)
    nodes, drift = transforms(plane), np.cumsum(rng.uniform(0, 0.05, (_NODES, 3)), axis=0)
    loops = []
    for _ in range(10):
        first, second = sorted(rng.choice(_NODES, 2, replace=False).tolist())
        away = rng.choice([0.0, 0.0, 0.3, 3.0]) * rng.normal(0.0, 1.0, 3)
        loops.append(loop(first, second, planar.between(plane[first], plane[second]) + away))
    agreement, rest = Agreement(), list(loops)
    while rest:
        count = int(rng.integers(1, 4))
        agreement.add(rest[:count], nodes, drift)
        rest = rest[count:]
    assert agreement.loops == loops and agreement.largest() == consistent(loops, nodes, drift)
    left = [one for one in loops if one.second < kept]
    agreement.cut(kept)
    assert agreement.loops == left and agreement.largest() == consistent(left, nodes, drift)
    agreement.add(loops[:3], nodes, drift)
    assert agreement.largest() == consistent([*left, *loops[:3]], nodes, drift)


# Poses.


def test_the_first_pose_of_a_stamp_is_what_was_reported_online():
    atlas = Atlas(voxel_m=0.05)
    for stamp_ns, x_m in ((1, 0.0), (3, 1.0), (2, 5.0), (3, 6.0), (4, 2.0)):
        atlas.add(stamp_ns, at(x_m), "a")
    for found in (atlas.online, atlas.trajectory):
        assert found.stamps_ns.tolist() == [1, 3, 4]
        assert found.positions_m[:, 0].tolist() == [0.0, 1.0, 2.0]


def path_of(T_map_base, sessions, is_bridged, reported):
    count = len(T_map_base)
    return PosedPath(
        T_map_base=np.stack(T_map_base),
        sessions=np.array(sessions),
        is_bridged=np.array(is_bridged),
        reported=np.stack([reported] * count),
    )


def test_a_bridged_pose_is_as_uncertain_as_the_last_measured_one_and_the_bridge():
    poses = [at(0.1 * index) for index in range(3)]
    path = path_of(poses, [0] * 3, [False, True, True], CLAIM)
    found = covariances(path, loops=[], bridge=WHEELS)
    per_m, turn = 0.02 * 0.2, 0.01 * 0.2
    bridge = per_m**2 + (turn * 0.1) ** 2
    map_drift = CLAIM[0, 0] * 0.2 / 2.5
    assert found[0, 0, 0] == pytest.approx(CLAIM[0, 0], rel=1e-3)
    assert found[2, 0, 0] == pytest.approx(CLAIM[0, 0] + map_drift + bridge, rel=1e-3)
    assert found[2, 5, 5] == pytest.approx(CLAIM[5, 5] * (1.0 + 0.2 / 2.5) + turn**2, rel=1e-3)
    none = path_of(poses, [0] * 3, [True] * 3, np.full((6, 6), np.nan))
    assert covariances(none, loops=[], bridge=WHEELS)[0, 0, 0] < 1e-9


def test_claims_are_scaled_by_the_drift_between_two_modules_beyond_their_noise():
    count, off_m = 5, 0.01
    poses = [at(0.5 * index) for index in range(count)]
    path = path_of(poses * 2, [0] * count + [1] * count, [False] * 2 * count, CLAIM)
    away = [at(off_m * index) for index in range(count)]
    both = [
        Trajectory(stamps_ns=np.arange(count), T_world_base=np.stack(one))
        for one in (poses, [T @ off for T, off in zip(poses, away, strict=True)])
    ]
    found = calibrated(path, "ab", both).reported
    steps = np.arange(count)
    drift = off_m**2 * ((steps**2).sum() - (count - 1))
    per_submap = drift / (2.0 * np.minimum(steps * 0.5 / 2.5, 1.0).sum())
    ratio = (per_submap / 4.0 / CLAIM[0, 0] + 3.0) / 6.0
    np.testing.assert_allclose(found, [CLAIM * ratio] * 2 * count, rtol=1e-3, atol=1e-12)


# Values.


def test_values_of_the_back_end_are_frozen_and_compared_by_identity():
    """Arrays cannot be compared by ==; what is not frozen receives poses."""
    growing = {"OpenSession", "PoseLog", "PosePath", "OpenSubmap", "Chain"}
    seen = 0
    for module in pkgutil.walk_packages(sceneslam.atlas.__path__, "sceneslam.atlas."):
        for name, value in vars(importlib.import_module(module.name)).items():
            if not (isinstance(value, type) and is_dataclass(value)) or name in growing:
                continue
            if value.__module__ != module.name:
                continue
            assert value.__dataclass_params__.frozen and "__slots__" in vars(value), name
            assert all(field.kw_only for field in fields(value)), name
            has_array = any("NDArray" in str(field.type) for field in fields(value))
            assert not (has_array and value.__dataclass_params__.eq), name
            seen += 1
    assert seen > 15


def test_a_solution_on_the_way_leaves_out_what_does_not_fit():
    own, wrong = finished(48), loop(1, 6, [14.0, 1.0, 0.0], sigma=0.01)
    loops = [off(0, 5), off(0, 6), wrong, off(1, 7)]
    solved = settle(np.array(own.chain.T_run_node), own.chain.motions, loops)
    assert solved.accepted == [0, 1, 3]
    alone = settle(np.array(own.chain.T_run_node), own.chain.motions, [*loops[:2], loops[3]])
    np.testing.assert_allclose(solved.T_map_node, alone.T_map_node, atol=1e-3)


def test_a_pose_that_is_gone_leaves_its_submap_where_it_was():
    own = finished()
    before = list(own.chain.T_run_node)
    own.chain.remeasure(lambda ns: None if ns < 3 * S else at(1.0 + 0.5 * ns / S))
    np.testing.assert_array_equal(own.chain.T_run_node[0], before[0])
    np.testing.assert_allclose(own.chain.T_run_node[1], at(1.0) @ before[1])
