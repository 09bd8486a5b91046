"""Loops that are found while the run goes on, and the graph that is solved with them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from planar_poses import transforms
from test_atlas_graph import Given, finished, solved
from test_atlas_limits import loop
from test_atlas_maps import WALL, map_of
from test_atlas_submaps import S, at

from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.submaps import graph as graph_of
from sceneslam.atlas.submaps import run_graph
from sceneslam.atlas.submaps.graph import Agreement, consistent, settle
from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.atlas.submaps.run_graph import RunGraph, SolvedRun
from sceneslam.types import planar


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
        drift = views.queries[second].drift.sums  # plans are searched when there are more submaps
        np.testing.assert_array_equal(plans.queries[second].drift.sums[: len(drift)], drift)


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
        np.testing.assert_array_equal(query.drift.sums, own.chain.drift[: len(query.drift.sums)])
    np.testing.assert_array_equal(query.plane[8], planar.from_transform(own.chain.T_run_node[8]))


def test_loops_of_a_search_that_was_interrupted_are_found_again(monkeypatch):
    Searched(monkeypatch, [off(0, 5), off(0, 6), off(1, 7)])
    own, compare = finished(48), graph_of._agree
    graph = RunGraph(empty_map(), lambda session: False)
    graph.extend(grown(own, 7), is_level=True)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(graph_of, "_agree", interrupted)
    with pytest.raises(KeyboardInterrupt):
        graph.extend(own.chain, is_level=True)
    monkeypatch.setattr(graph_of, "_agree", compare)
    assert len(graph.extend(own.chain, is_level=True).loops) == 3


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


@pytest.mark.parametrize(("aside_m", "count"), [(0.02, 2), (3.0, 0)])
def test_a_loop_that_the_final_nodes_contradict_is_left_out(monkeypatch, aside_m, count):
    Given(monkeypatch, found=[off(0, 5, aside_m), off(0, 6, aside_m)])
    assert len(solved(finished(48)).loops) == count


def test_a_solution_is_cut_with_its_loops():
    loops = tuple(loop(*ends, [1.0, 0.0, 0.0]) for ends in ((0, 4), (2, 5), (3, 6)))
    found = SolvedRun(T_map_node=np.tile(np.eye(4), (5, 1, 1)), loops=loops).cut(3, loaded=3)
    assert len(found.T_map_node) == 3 and found.loops == loops[:2]


_NODES = 12


@given(st.integers(0, 10**6), st.integers(0, _NODES))
def test_loops_that_are_compared_as_they_are_found_agree_as_all_at_once(seed, kept):
    rng = np.random.default_rng(seed)
    plane = np.cumsum(rng.normal(0.0, 1.0, (_NODES, 3)), axis=0)
    nodes = transforms(plane)
    drift = PathDrift(sums=np.cumsum(rng.uniform(0, 0.05, (_NODES, 2, 3)), axis=0))
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


def test_a_solution_on_the_way_leaves_out_what_does_not_fit():
    own, wrong = finished(48), loop(1, 6, [14.0, 1.0, 0.0], sigma=0.01)
    loops = [off(0, 5), off(0, 6), wrong, off(1, 7)]
    solved = settle(np.array(own.chain.T_run_node), own.chain.motions, loops)
    assert solved.accepted == [0, 1, 3]
    alone = settle(np.array(own.chain.T_run_node), own.chain.motions, [*loops[:2], loops[3]])
    np.testing.assert_allclose(solved.T_map_node, alone.T_map_node, atol=1e-3)
