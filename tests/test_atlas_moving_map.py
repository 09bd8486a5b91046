"""A loaded map that a run shows to be bent is straightened; what the run does not show stays."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_limits import loop
from test_atlas_maps import WALL, edge, map_of
from test_atlas_submaps import Known, S, at, collector, pitched, run_of

from sceneslam.atlas.places.localizer import Fix
from sceneslam.atlas.submaps import run_graph
from sceneslam.atlas.submaps.chain import Chain
from sceneslam.atlas.submaps.graph import connected, on_floor
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.atlas.submaps.uprights import straightened, uprights

SURE, ROUGH = on_floor(np.diag([0.02, 0.02, 0.005]) ** 2), on_floor(np.diag([0.3, 0.3, 0.1]) ** 2)
STRETCH_M = 0.4  # by which the map's second half lies too far ahead


def due(stamp_ns):
    """A drive of 1 m/s straight ahead."""
    return at(stamp_ns / S)


def bent_map(*, last_piece=0):
    """Eleven submaps 3 m apart, the sixth too far from the fifth, and one that is not connected."""
    along = [3.0 * k + (STRETCH_M if k > 5 else 0.0) for k in range(11)]
    edges = [
        replace(edge(k, k + 1, (along[k + 1] - along[k], 0.0, 0.0)), covariance=ROUGH)
        for k in range(10)
    ]
    nodes = [[x_m, 0.0, 0.0] for x_m in along] + [[-9.0, 4.0, 0.0]]
    return map_of(*[WALL] * 12, nodes=nodes, pieces=[0] * 11 + [last_piece], edges=edges)


def finished(loaded, *, moves_loaded, fixes):
    """The graph of a drive over the whole map, at its end."""
    own = collector(lambda ns: Known(T_map_base=due(ns), session=0, module="a", covariance=None))
    for second in range(31):
        own.step_to(due(second * S))
        own.add(second * S, None)
    own.finish()
    graph = RunGraph(loaded, lambda session: False, moves_loaded=moves_loaded)
    nodes = np.stack(own.chain.T_run_node)
    return graph.finish(own.chain, nodes, due, (), fixes, is_level=True)


def seen():
    """Where the run is found in the map as it was loaded."""
    return [
        Fix(
            stamp_ns=second * S,
            T_map_base=at(STRETCH_M if second > 17 else 0.0) @ due(second * S),
            T_run_base=due(second * S),
            covariance=SURE,
        )
        for second in range(31)
    ]


@pytest.mark.parametrize("last_piece", [0, 1])
def test_a_run_straightens_the_map_that_it_was_found_in(last_piece):
    loaded = bent_map(last_piece=last_piece)
    found = finished(loaded, moves_loaded=True, fixes=seen())
    along = found.T_map_loaded[:11, 0, 3]
    np.testing.assert_allclose(along[0], 0.0, atol=0.01)
    assert abs(along[10] - 30.0) < 0.15 * STRETCH_M
    np.testing.assert_allclose(
        found.T_map_node[:, 0, 3], np.arange(0, 31, 3)[: len(along)], atol=0.06
    )
    np.testing.assert_allclose(found.T_map_loaded[11], loaded.T_map_node[11], atol=1e-6)
    assert len(found.loops) > 8


def test_a_map_that_is_not_saved_again_stays_as_it_is():
    loaded = bent_map()
    found = finished(loaded, moves_loaded=False, fixes=seen())
    assert found.T_map_loaded is None
    assert abs(found.T_map_node[-1, 0, 3] - 30.0 - STRETCH_M) < 0.1


def test_a_run_that_was_not_found_moves_no_map():
    assert finished(bent_map(), moves_loaded=True, fixes=[]).T_map_loaded is None


def test_a_place_of_an_earlier_run_that_contradicts_all_others_hardly_bends_the_map():
    straight = [edge(k, k + 1, (3.0, 0.0, 0.0)) for k in range(10)]
    wrong = replace(loop(0, 10, [27.0, 0.0, 0.0]), covariance=SURE)
    nodes = [[3.0 * k, 0.0, 0.0] for k in range(11)]
    loaded = map_of(*[WALL] * 11, nodes=nodes, edges=[*straight, wrong])
    fixes = [
        Fix(
            stamp_ns=second * S,
            T_map_base=due(second * S),
            T_run_base=due(second * S),
            covariance=SURE,
        )
        for second in range(31)
    ]
    found = finished(loaded, moves_loaded=True, fixes=fixes)
    assert np.abs(found.T_map_loaded[:, 0, 3] - loaded.T_map_node[:, 0, 3]).max() < 0.1


def test_what_earlier_runs_recognized_holds_the_map():
    bent = bent_map()
    motions = [edge for edge in bent.edges if edge.second < 10]  # the last two hang together by it
    right = replace(loop(0, 10, [30.0 + STRETCH_M, 0.0, 0.0]), covariance=SURE)
    fixes = [fix for fix in seen() if fix.stamp_ns < 20 * S]
    nodes = np.array(bent.T_map_node)
    nodes[10, 0, 3] += 0.2
    bent = replace(bent, T_map_node=nodes, edges=(*motions, right))
    found = finished(bent, moves_loaded=True, fixes=fixes)
    np.testing.assert_allclose(found.T_map_loaded[10, 0, 3], 30.0 + STRETCH_M, atol=0.02)
    assert found.T_map_loaded[6, 0, 3] < 18.0 + 0.5 * STRETCH_M


def test_parts_that_no_edge_connects_are_joined_by_the_run():
    bent = bent_map()
    edges = tuple(edge for edge in bent.edges if edge.first != 5)
    found = finished(replace(bent, edges=edges), moves_loaded=True, fixes=seen())
    np.testing.assert_allclose(found.T_map_loaded[:11, 0, 3], np.arange(0, 31, 3), atol=0.03)
    np.testing.assert_array_equal(found.T_map_loaded[0], bent.T_map_node[0])


def test_parts_that_edges_connect_are_told_apart():
    edges = [edge(0, 2), edge(5, 2), edge(3, 4), edge(4, 1)]
    assert connected([0, 2, 3, 4, 5, 6], edges) == [[0, 2, 5], [3, 4], [6]]
    assert connected([], edges) == []


def tilted(tilts, run):
    """Submaps of a run whose base stands pitched by these angles [rad]."""
    own = run_of(18)
    own.finish()
    return [
        replace(submap, run=run, up=pitched(0, 0, tilt)[2, :3])
        for submap, tilt in zip(own.chain.submaps, tilts, strict=True)
    ]


def test_a_run_is_straightened_by_its_own_usual_tilt():
    unknown = replace(tilted([0.0, 0.0, 0.0], 0)[0], up=None)
    run = [*tilted([0.10, 0.12, 0.10], 0), unknown]
    submaps = straightened(Chain(submaps=run, T_run_node=[at()] * 4))
    assert submaps[-1].up is None
    for submap, tilt in zip(submaps, [0.0, 0.02, 0.0], strict=False):
        np.testing.assert_allclose(submap.up, pitched(0, 0, tilt)[2, :3], atol=1e-9)
    assert straightened(Chain(submaps=[unknown], T_run_node=[at()])) == [unknown]


def test_submaps_are_held_upright_as_the_first_one_is():
    submaps = [*tilted([0.0, 0.02, 0.01], 0), *tilted([0.03, 0.0, 0.0], 1)]
    nodes = np.stack([pitched(0, 0, 0.0)] * 6)
    nodes[5] = pitched(0, 0, 0.1)
    found = uprights(submaps, nodes, [5, 0, 1])
    assert [one.node for one in found] == [5, 0, 1]
    for one, tilt in zip(found, [0.0, 0.0, 0.02], strict=True):
        np.testing.assert_allclose(one.up_node, pitched(0, 0, tilt)[2, :3], atol=1e-9)
        np.testing.assert_allclose(one.up_map, pitched(0, 0, -0.1)[2, :3], atol=1e-9)
    assert uprights(submaps, nodes, []) == []


@pytest.mark.parametrize(
    ("moves_loaded", "is_found", "held"), [(True, True, 4), (True, False, 3), (False, True, 3)]
)
def test_the_upright_submaps_of_a_map_hold_a_run_if_it_moves(
    monkeypatch, moves_loaded, is_found, held
):
    taken = []
    given = lambda submaps, nodes, which: taken.extend(which) or []  # noqa: E731
    monkeypatch.setattr(run_graph, "uprights", given)
    loaded = map_of(WALL, WALL, pieces=[0, 1])
    own = run_of(18)
    own.finish()
    graph = RunGraph(loaded, lambda session: False, moves_loaded=moves_loaded)
    fixes = (
        [Fix(stamp_ns=2 * S, T_map_base=due(S), T_run_base=due(2 * S), covariance=SURE)]
        if is_found
        else []
    )
    nodes = np.stack(own.chain.T_run_node)
    found = graph.finish(own.chain, nodes, due, (), fixes, is_level=True)
    assert taken == [0, 2, 3, 4][-held:]
    assert (found.T_map_loaded is None) == (held == 3)
