"""Maps joined by what cameras saw, and views that later ones replace."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_maps import map_of
from test_views import ELSEWHERE, HERE, MOUNT, base_of, landmarks_at, place, points_of

from sceneslam.atlas.lasting.merge import join_pieces
from sceneslam.atlas.lasting.saved_map import forget_contradicted
from sceneslam.atlas.places.floor_plan import join
from sceneslam.types import se3
from sceneslam.views.landmark_registration import recognize, register
from sceneslam.views.placed_views import PlacedViews
from sceneslam.views.view import PlacedView

TILTED = se3.exp(np.array([0.2, -0.1, 0.3, 0.05, -0.1, 0.3]))


def seen_from(T_place_base, seed, *, noise_m=0.0, wrong=0.0):
    """The landmarks of a place as seen from a pose in it; a share of them lies elsewhere."""
    rng, true = np.random.default_rng(seed + 50), place(seed)
    points = se3.apply(se3.inverse(T_place_base), points_of(true))
    points += rng.normal(0, noise_m, points.shape)
    is_wrong = rng.random(len(points)) < wrong
    points[is_wrong] = rng.uniform(-3, 3, (is_wrong.sum(), 3))
    return landmarks_at(points, true.descriptors)


@pytest.mark.parametrize(("noise_m", "wrong", "off_m"), [(0, 0, 1e-6), (0.02, 0.5, 0.02)])
def test_two_views_are_registered_by_their_landmarks(noise_m, wrong, off_m):
    other = seen_from(TILTED, 1, noise_m=noise_m, wrong=wrong)
    found = register(HERE @ MOUNT, place(1), other)
    off = se3.log(se3.inverse(HERE @ TILTED) @ base_of(found))
    assert np.linalg.norm(off[:3]) < off_m and found.matches > (1 - wrong) * 170
    covariance = se3.carried(found.covariance, MOUNT)
    assert off @ np.linalg.solve(covariance, off) < 16.8  # 99 % of six
    assert register(HERE @ MOUNT, place(1), seen_from(TILTED, 2)) is None
    assert register(HERE @ MOUNT, place(1), seen_from(TILTED, 1, wrong=0.95)) is None


def test_corners_of_uncertain_distance_are_not_registered():
    """Of 200 corners 100 are 15 per cent too far away, as motion located them."""
    rough = place(1)
    rough.points_cam[::2] *= 1.15
    rough.deviation_m[::2] = 0.15 * np.linalg.norm(rough.points_cam[::2], axis=1)
    found = register(HERE @ MOUNT, rough, seen_from(TILTED, 1))
    off = se3.inverse(HERE @ TILTED) @ base_of(found)
    assert found.matches == 100 and np.linalg.norm(off[:3, 3]) < 1e-3


def test_places_that_look_alike_are_not_recognized():
    other = seen_from(TILTED, 1)
    known = PlacedViews([(HERE @ MOUNT, place(1)), (ELSEWHERE @ MOUNT, place(2))])
    number, seen = recognize(known, other)
    assert number == 0
    np.testing.assert_allclose(base_of(seen), HERE @ TILTED, atol=1e-5)
    alike = PlacedViews([(HERE @ MOUNT, place(1)), (ELSEWHERE @ MOUNT, place(1))])
    assert recognize(alike, other) is None
    for number, T_map_seen in enumerate((HERE, ELSEWHERE)):
        found, seen = recognize(alike, other, among=[number])
        assert found == number
        np.testing.assert_allclose(base_of(seen), T_map_seen @ TILTED, atol=1e-5)
    assert recognize(alike, other, among=[]) is None
    assert recognize(PlacedViews([]), other) is None


def test_views_that_are_added_moved_and_cut_are_recognized_where_they_are():
    known, other = PlacedViews([(HERE @ MOUNT, place(2))]), seen_from(TILTED, 1)
    known.add(HERE @ MOUNT, place(1))
    known.move([HERE @ MOUNT, ELSEWHERE @ MOUNT])
    number, seen = recognize(known, other)
    assert (len(known), number) == (2, 1)
    np.testing.assert_allclose(base_of(seen), ELSEWHERE @ TILTED, atol=1e-5)
    known.cut(1)
    assert len(known) == 1 and recognize(known, other) is None
    known.add(HERE @ MOUNT, place(1))
    number, seen = recognize(known, other)
    assert number == 1
    np.testing.assert_allclose(base_of(seen), HERE @ TILTED, atol=1e-5)
    with pytest.raises(ValueError, match="argument"):
        known.move([HERE])


def viewed(saved, *views):
    """The map with these (pose in the submap, landmarks) as the views of its submaps."""
    return replace(
        saved,
        submaps=tuple(
            replace(
                submap,
                views=tuple(
                    PlacedView(stamp_ns=number, T_submap_cam=T @ MOUNT, landmarks=landmarks)
                    for number, (T, landmarks) in enumerate(own)
                ),
            )
            for submap, own in zip(saved.submaps, views, strict=True)
        ),
    )


def test_pieces_are_joined_by_two_views_that_agree():
    flat, aside = join([]), se3.from_xy_yaw(1.0, 0.5, 0.3)
    saved = map_of(flat, flat, nodes=[[2, 1, 0.4], [0, 0, 0]], pieces=[0, 1], runs=[0, 1])
    first = [(se3.identity(), place(1)), (aside, place(2))]
    T_first_second = TILTED  # of the submaps; it was held by hand
    second = [
        (se3.identity(), seen_from(T_first_second, 1)),
        (se3.identity(), seen_from(se3.inverse(aside) @ T_first_second, 2)),
    ]
    joined = join_pieces(viewed(saved, first, second))
    assert joined.apart == 0 and (joined.pieces == 0).all()
    expected = saved.T_map_node[0] @ T_first_second
    np.testing.assert_allclose(joined.T_map_node[1], expected, atol=0.01)
    alone = join_pieces(viewed(saved, first, second[:1]))
    assert alone.apart == 1
    contradicting = [second[0], (aside, second[1][1])]
    assert join_pieces(viewed(saved, first, contradicting)).apart == 1


def test_a_view_goes_where_the_newest_run_has_one_nearby():
    flat = join([])
    saved = map_of(flat, flat, nodes=[[2, 1, 0.4], [0, 0, 0]], runs=[0, 1])
    at = saved.T_map_node[0]
    poses = [se3.identity(), se3.from_xy_yaw(0.4, 0, 0.3), se3.from_xy_yaw(0.6, 0, 0), TILTED]
    poses += [se3.from_xy_yaw(0, 0, 0.5)]
    old = [(T, place(number)) for number, T in enumerate(poses)]
    left = forget_contradicted(viewed(saved, old, [(at, place(9))]), 1)
    assert [view.stamp_ns for view in left.submaps[0].views] == [2, 4]
    assert len(left.submaps[1].views) == 1
    kept = forget_contradicted(viewed(saved, old, []), 1)
    assert len(kept.submaps[0].views) == 5


@pytest.mark.parametrize(("count", "left"), [(90, 1), (110, 0)])
def test_a_poor_view_takes_the_place_of_none_with_twice_its_landmarks(count, left):
    flat = join([])
    saved = map_of(flat, flat, runs=[0, 1])
    views = [(se3.identity(), place(0, 200))], [(se3.identity(), place(9, count))]
    assert len(forget_contradicted(viewed(saved, *views), 1).submaps[0].views) == left
