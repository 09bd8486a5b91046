"""Loops between submaps by what a camera saw in both, whatever modules made them."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_loops import query_of
from test_atlas_maps import WALL, map_of
from test_view_merge import seen_from
from test_views import MOUNT, place

from sceneslam.atlas.submaps.view_loops import ViewLoops
from sceneslam.types import se3
from sceneslam.views.landmark_registration import register
from sceneslam.views.view import PlacedView

ASIDE = se3.from_xy_yaw(0.4, -0.2, 0.5)  # of the second view, in the place of the first
ANY = 2.0 * np.ones(3)  # deviations: the second submap may lie anywhere near


def viewed(submap, *views):
    """The submap with views (pose in it, landmarks)."""
    placed = (PlacedView(stamp_ns=0, T_submap_cam=T @ MOUNT, landmarks=seen) for T, seen in views)
    return replace(submap, views=tuple(placed))


def two(first=1, second=1, *, T_second_view=ASIDE):
    """Two submaps: the second begins at ASIDE in the place that both see."""
    submaps = map_of(WALL, WALL, runs=[0, 0]).submaps
    T_place_view = ASIDE @ T_second_view
    return [
        viewed(submaps[0], (se3.identity(), place(first))),
        viewed(submaps[1], (T_second_view, seen_from(T_place_view, second))),
    ]


def always(first, second, submaps):
    return True


def loops_to(finder, second, submaps, nodes, sigma):
    """Find loops, with deviations `sigma` (3,) of the motion from any other submap to this one."""
    drift = np.outer(np.arange(len(submaps)) == second, sigma)
    return finder.loops_to(query_of(second, submaps, nodes, drift))


def added(finder, submaps, nodes, sigma):
    """Return the loops to each submap in turn, and which of its views are kept."""
    loops, kept = [], []
    for second, submap in enumerate(submaps):
        found, views = loops_to(finder, second, submaps, nodes, sigma)
        loops.append(found)
        kept.append([view in views for view in submap.views])
    return loops, kept


def loops_in(submaps, nodes, sigma=ANY, may_close=always):
    (first, second), _ = added(ViewLoops(may_close), submaps, nodes, sigma)
    assert first == []
    return second


@pytest.mark.parametrize("off_m", [0.0, 1.5])
def test_a_place_seen_again_gives_the_motion_between_the_submaps(off_m):
    expected = se3.from_xy_yaw(0.4 + off_m, -0.2, 0.6)
    (loop,) = loops_in(two(), [se3.identity(), expected])
    assert (loop.first, loop.second, loop.is_loop) == (0, 1, True)
    np.testing.assert_allclose(loop.T_first_second, ASIDE, atol=1e-5)
    tilted = se3.exp(np.array([0.0, 0.0, 0.0, 0.1, -0.2, 0.3]))
    (loop,) = loops_in(two(T_second_view=tilted), [se3.identity(), expected])
    np.testing.assert_allclose(loop.T_first_second, ASIDE, atol=1e-5)


def test_the_covariance_is_that_of_the_view_at_the_submap():
    T_second_view = se3.from_xy_yaw(2.0, 0.0, 0.0)
    submaps = two(T_second_view=T_second_view)
    (loop,) = loops_in(submaps, [se3.identity(), ASIDE])
    seen = register(se3.identity(), place(1), submaps[1].views[0].landmarks)
    at_view = se3.carried(seen.covariance, MOUNT)
    expected = se3.carried(at_view, T_second_view)
    np.testing.assert_allclose(loop.covariance, expected, rtol=1e-6, atol=1e-12)
    assert abs(expected[1, 1] / at_view[1, 1] - 1.0) > 0.2


def test_another_place_is_no_loop():
    assert loops_in(two(1, 2), [se3.identity(), ASIDE]) == []


def test_a_place_farther_away_than_drift_explains_is_no_loop():
    away = se3.from_xy_yaw(3.0, 0.0, 0.0)
    small = np.array([0.3, 0.3, 0.01])
    assert loops_in(two(), [se3.identity(), away], small) == []
    assert len(loops_in(two(), [se3.identity(), away])) == 1


def test_what_drift_cannot_improve_is_not_compared():
    little = np.array([0.019, 0.019, 0.0])
    assert loops_in(two(), [se3.identity(), ASIDE], little) == []
    enough = np.array([0.021, 0.021, 0.0])
    assert len(loops_in(two(), [se3.identity(), ASIDE], enough)) == 1


def test_submaps_that_may_not_be_connected_are_not():
    asked = []

    def refuses(first, second, submaps):
        asked.append((first, second, len(submaps)))
        return False

    assert loops_in(two(), [se3.identity(), ASIDE], may_close=refuses) == []
    assert asked == [(0, 1, 2)]


def test_two_places_that_look_alike_give_no_loop():
    submaps = [*two(), two()[1]]
    nodes = [se3.identity(), se3.from_xy_yaw(3.0, 0.0, 0.0) @ ASIDE, ASIDE]
    finder = ViewLoops(lambda first, second, submaps: second == 2)
    loops, kept = added(finder, submaps, nodes, ANY)
    assert loops == [[], [], []] and kept == [[True]] * 3


def test_of_several_views_of_one_submap_the_best_gives_the_loop():
    first, second = two()
    poorer = seen_from(ASIDE, 1, wrong=0.5)
    better = second.views[0].landmarks
    T = second.views[0].T_submap_cam @ se3.inverse(MOUNT)
    submaps = [first, viewed(second, (se3.identity(), poorer), (T, better))]
    (loop,) = loops_in(submaps, [se3.identity(), ASIDE])
    np.testing.assert_allclose(loop.T_first_second, ASIDE, atol=1e-5)


def test_forgotten_submaps_are_not_seen_again_until_they_come_back():
    finder, submaps = ViewLoops(always), two()
    nodes = [se3.identity(), ASIDE]
    added(finder, submaps, nodes, ANY)
    finder.forget(1)
    assert len(loops_to(finder, 1, submaps, nodes, ANY)[0]) == 1
    finder.forget(0)
    assert loops_to(finder, 0, submaps, nodes, ANY)[0] == []


@pytest.mark.parametrize(("aside_m", "is_kept"), [(0.45, False), (0.55, True)])
def test_a_view_that_shows_what_a_known_one_shows_is_not_kept(aside_m, is_kept):
    ahead = se3.from_xy_yaw(aside_m, 0.0, 0.0)
    submaps = two(T_second_view=se3.inverse(ASIDE) @ ahead)
    for nodes, sigma in (
        ([se3.identity(), se3.from_xy_yaw(1.5, 0.0, 0.0) @ ASIDE], ANY),  # it is recognized
        ([se3.identity(), ASIDE], np.zeros(3)),  # it is known where it is
    ):
        _, kept = added(ViewLoops(always), submaps, nodes, sigma)
        assert kept == [[True], [is_kept]]


def test_views_of_a_session_that_closes_its_loops_are_known_where_they_are():
    def refuses(first, second, submaps):
        return False

    _, kept = added(ViewLoops(refuses), two(), [se3.identity(), ASIDE], ANY)
    assert kept == [[True], [True]]  # ASIDE is turned by more than shows the same
    same = two(T_second_view=se3.inverse(ASIDE))
    assert added(ViewLoops(refuses), same, [se3.identity(), ASIDE], ANY)[1] == [[True], [False]]


def test_a_rich_view_is_kept_where_a_poor_one_was_taken_before():
    """As in the light, where the robot came by in the dark."""
    first, second = two()
    near = se3.from_xy_yaw(0.1, 0.0, 0.0)
    submaps = [
        viewed(first, (se3.identity(), place(2, 60))),
        viewed(second, (se3.identity(), place(1, 200))),
    ]
    _, kept = added(ViewLoops(lambda *_: False), submaps, [se3.identity(), near], 0.0 * ANY)
    assert kept == [[True], [True]]
    submaps[0] = viewed(first, (se3.identity(), place(2, 200)))
    _, kept = added(ViewLoops(lambda *_: False), submaps, [se3.identity(), near], 0.0 * ANY)
    assert kept == [[True], [False]]
