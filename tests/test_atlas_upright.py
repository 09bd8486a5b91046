"""Submaps stand upright where gyro and gravity, or a level floor, measure which way is up."""

from itertools import accumulate

import numpy as np
import pytest
from test_atlas_submaps import RIG, S, at, pitched, unseen

from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.atlas.submaps.uprights import turning_axis, usual_up
from sceneslam.types import se3


def known_at(T_map_base):
    return Known(T_map_base=T_map_base, session=0, module="a", covariance=None)


def finished(poses, ups):
    """The nodes of a run along poses, a second each, by its motions alone, and as solved."""
    own = Collector(RIG, lambda ns: known_at(poses[ns // S]), 0, unseen)
    for index, (T, up) in enumerate(zip(poses, ups, strict=True)):
        own.step_to(T)
        own.add(index * S, None, up)
    own.finish()
    nodes = np.stack(own.chain.T_run_node)
    graph = RunGraph(empty_map(), lambda session: False)
    path = lambda ns: poses[ns // S]  # noqa: E731
    solved = graph.finish(own.chain, nodes, path, [], [], is_level=own.is_level)
    return nodes, solved.T_map_node


@pytest.mark.parametrize("askew_rad", [0.0, 0.1])
def test_submaps_stand_upright_however_the_sensor_is_mounted(askew_rad):
    """A module's pitch drifts by 2 degrees along 12 m of level floor, there and back."""
    turns = np.linspace(0.0, 0.035, 24)
    poses = [pitched(min(k, 23 - k), 0.02 * k, turn) for k, turn in enumerate(turns)]
    half_turn = at(0.0, 0.0, np.pi)
    poses = [T if k < 12 else T @ half_turn for k, T in enumerate(poses)]
    nodes, solved = finished(poses, [pitched(0.0, 0.0, askew_rad)[:3, 2]] * len(poses))
    assert nodes[-1, 2, 2] < np.cos(0.03)
    assert (np.arccos(solved[:, 2, 2]) < 0.01).all()
    np.testing.assert_allclose(solved[:, 0, 3], nodes[:, 0, 3], atol=0.05)


def there_and_back():
    ahead = [at(float(k)) for k in range(12)]
    return [*ahead, *(at(11.0 - k, 0.5, np.pi) for k in range(12))]


def test_a_base_that_is_pitched_is_not_straightened():
    poses = [T @ pitched(0.0, 0.0, 0.1) for T in there_and_back()]
    nodes, solved = finished(poses, [T[2, :3] for T in poses])
    np.testing.assert_allclose(solved, nodes, atol=1e-6)


def test_a_run_that_is_mostly_on_a_ramp_is_not_straightened():
    ramp, turn, step = pitched(0.0, 0.0, -0.09), at(0.0, 0.0, np.pi / 2), at(1.0)
    steps = [ramp, *[step] * 30, step @ se3.inverse(ramp), *[step, step @ turn, step] * 4]
    poses = list(accumulate(steps, np.matmul))
    nodes, solved = finished(poses, [T[2, :3] for T in poses])
    np.testing.assert_allclose(solved, nodes, atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_nodes_that_stand_on_their_head_or_lie_on_their_side_have_a_direction():
    """Wheels whose z is downwards: the first node is that of the map, the other one is not."""
    up, over, side = np.array([0.0, 0.0, 1.0]), np.diag([1.0, -1.0, -1.0, 1.0]), np.eye(4)
    side[:3, :3] = [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    own = Collector(RIG, lambda ns: known_at(at(0.0)), 0, unseen)
    own.step_to(at(0.0))
    own.add(0, None, None)
    own.finish()
    submaps = [own.chain.submaps[0]] * 2
    for second in (over, side @ over, side):
        for nodes in (np.stack([np.eye(4), second]), np.stack([side, second])):
            for found in (usual_up(submaps, nodes, up), turning_axis(nodes)):
                assert np.linalg.norm(found) == pytest.approx(1.0)
    np.testing.assert_array_equal(usual_up(submaps, np.stack([np.eye(4), over]), up), up)
