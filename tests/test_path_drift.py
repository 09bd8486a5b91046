"""What the errors of a path's motions add up to."""

import numpy as np
import pytest

from sceneslam.atlas.submaps.path_drift import PathDrift, summed
from sceneslam.graphs.edge import Edge, EdgeKind

NOTHING = np.zeros((2, 3))


def motion(kind, deviations):
    """A motion whose x, y [m] and yaw [rad] have these deviations (3,)."""
    variances = np.zeros(6)
    variances[[0, 1, 5]] = np.square(deviations)
    covariance = np.diag(variances)
    return Edge(first=0, second=1, T_first_second=np.eye(4), covariance=covariance, kind=kind)


def test_deviations_of_bridges_add_up_and_of_a_map_their_variances():
    off = np.array([0.3, 0.2, 0.1])
    sums = summed(summed(NOTHING, motion(EdgeKind.BRIDGE, off)), motion(EdgeKind.BRIDGE, 2 * off))
    np.testing.assert_allclose(sums, [3 * off, np.zeros(3)])
    mapped = summed(summed(NOTHING, motion(EdgeKind.MOTION, off)), motion(EdgeKind.MOTION, 2 * off))
    assert (mapped[0] == 0.0).all()
    np.testing.assert_allclose(mapped[1], 5 * off**2, rtol=0.1)  # and what successive ones share


def test_small_errors_of_a_map_are_taken_for_correlated_and_large_ones_are_not():
    small = np.full(3, 1e-3)
    np.testing.assert_allclose(summed(NOTHING, motion(EdgeKind.MOTION, small))[1], 4 * small**2)
    larger = summed(NOTHING, motion(EdgeKind.MOTION, np.ones(3)))
    more = summed(NOTHING, motion(EdgeKind.MOTION, np.full(3, 2.0)))
    np.testing.assert_allclose(more[1] - larger[1], 3.0)


@pytest.mark.parametrize("seed", range(5))
def test_a_heading_that_is_off_moves_what_comes_after_by_its_distance(seed):
    rng = np.random.default_rng(seed)
    random, systematic = rng.uniform(0.0, 0.1, (2, 12))
    sums = np.zeros((12, 2, 3))
    sums[:, 0, 2], sums[:, 1, 2] = systematic.cumsum(), (random**2).cumsum()
    xy_m, second = rng.uniform(-50.0, 50.0, (12, 2)), 10
    swung_m = PathDrift.of(list(sums)).swing_m(xy_m, np.arange(second), second)
    for first in range(second):
        way = range(first + 1, second + 1)
        away_m = np.linalg.norm(xy_m - xy_m[second], axis=1)
        moved_m = np.sqrt(sum((random[k] * away_m[k]) ** 2 for k in way))
        turned_m = 0.5 * away_m[first] * sum(systematic[k] for k in way)
        assert swung_m[first] == pytest.approx(moved_m + turned_m)
