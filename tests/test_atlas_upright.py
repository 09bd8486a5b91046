"""Submaps stand upright where gyro and gravity, or a level floor, measure which way is up."""

import numpy as np
import pytest
from test_atlas_submaps import RIG, S, at, pitched, unseen

from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.run_graph import RunGraph


def known_at(T_map_base):
    return Known(T_map_base=T_map_base, session=0, module="a", covariance=None)


@pytest.mark.parametrize("askew_rad", [0.0, 0.1])
def test_submaps_stand_upright_however_the_sensor_is_mounted(askew_rad):
    """A module's pitch drifts by 2 degrees along 12 m of level floor, there and back."""
    turns = np.linspace(0.0, 0.035, 24)
    poses = [pitched(min(k, 23 - k), 0.02 * k, turn) for k, turn in enumerate(turns)]
    half_turn = at(0.0, 0.0, np.pi)
    poses = [T if k < 12 else T @ half_turn for k, T in enumerate(poses)]
    own = Collector(RIG, lambda ns: known_at(poses[ns // S]), 0, unseen)
    for index, T in enumerate(poses):
        own.step_to(T)
        own.add(index * S, None, pitched(0.0, 0.0, askew_rad)[:3, 2])
    own.finish()
    nodes = np.stack(own.chain.T_run_node)
    graph = RunGraph(empty_map(), lambda session: False)
    path = lambda ns: poses[ns // S]  # noqa: E731
    solved = graph.finish(own.chain, nodes, path, [], [], is_level=own.is_level).T_map_node
    assert nodes[-1, 2, 2] < np.cos(0.03)
    assert (np.arccos(solved[:, 2, 2]) < 0.01).all()
    np.testing.assert_allclose(solved[:, 0, 3], nodes[:, 0, 3], atol=0.05)
