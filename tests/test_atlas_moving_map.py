"""A loaded map that a run shows to be bent is straightened; what the run does not show stays."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_limits import loop
from test_atlas_maps import WALL, edge, map_of
from test_atlas_submaps import Known, S, at, collector, pitched, run_of

from sceneslam.atlas.places.localizer import Fix
from sceneslam.atlas.submaps.graph import first_of_parts, on_floor
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.atlas.submaps.uprights import uprights

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
    np.testing.assert_allclose(found.T_map_loaded, loaded.T_map_node, atol=1e-4)
    assert abs(found.T_map_node[-1, 0, 3] - 30.0 - STRETCH_M) < 0.1


def test_a_run_that_was_not_found_moves_no_map():
    loaded = bent_map()
    found = finished(loaded, moves_loaded=True, fixes=[])
    np.testing.assert_array_equal(found.T_map_loaded, loaded.T_map_node)


def test_a_place_of_an_earlier_run_that_contradicts_all_others_hardly_bends_the_map():
    straight = [edge(k, k + 1, (3.0, 0.0, 0.0)) for k in range(10)]
    wrong = replace(loop(0, 10, [27.0, 0.0, 0.0]), covariance=SURE)
    nodes = [[3.0 * k, 0.0, 0.0] for k in range(11)]
    loaded = map_of(*[WALL] * 11, nodes=nodes, edges=[*straight, wrong])
    fixes = [
        Fix(stamp_ns=second * S, T_map_base=due(second * S), covariance=SURE)
        for second in range(31)
    ]
    found = finished(loaded, moves_loaded=True, fixes=fixes)
    assert np.abs(found.T_map_loaded[:, 0, 3] - loaded.T_map_node[:, 0, 3]).max() < 0.1


def test_every_part_that_edges_connect_has_a_first_node():
    edges = [edge(0, 2), edge(5, 2), edge(3, 4), edge(4, 1)]
    assert first_of_parts([0, 2, 3, 4, 5, 6], edges) == [0, 3, 6]
    assert first_of_parts([], edges) == []


def test_each_run_has_its_own_usual_tilt_and_only_nodes_of_the_map_count():
    own = run_of(18)
    own.finish()
    tilts = [[0.10, 0.12, 0.10], [-0.2, -0.2, -0.23]]
    submaps = [
        replace(submap, run=run, up=pitched(0, 0, tilt)[2, :3])
        for run, tilted in enumerate(tilts)
        for submap, tilt in zip(own.chain.submaps, tilted, strict=True)
    ]
    nodes = np.stack([pitched(0, 0, 0.0)] * 6)
    found = uprights(submaps, nodes, [0, 1, 2, 5, 3])
    assert [one.node for one in found] == [0, 1, 2, 5, 3]
    for one, tilt in zip(found, [0.0, 0.02, 0.0, -0.015, 0.015], strict=True):
        np.testing.assert_allclose(one.up_node, pitched(0, 0, tilt)[2, :3], atol=1e-3)
        np.testing.assert_allclose(one.up_map, [0.0, 0.0, 1.0], atol=1e-9)
    assert uprights(submaps, nodes, []) == []
