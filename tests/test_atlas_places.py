"""Floor plans, and finding one in another, up to their limits.

Plans are drawn as text, the highest y first: `#` wall, `.` free, ` ` unknown; a cell is 0.05 m.
"""

from dataclasses import replace

import numpy as np
import pytest

from sceneslam.atlas.places import recognition
from sceneslam.atlas.places.floor_plan import FloorPlan, draw, grid_of, join
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.plan_search import Peak, PlanSearch, SearchWindow
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.places.registration import PlanRegistration, register
from sceneslam.scans.key_scan import KeyScan
from sceneslam.types import planar
from sceneslam.types.errors import InputError

S = 10**9
CELL = 0.05


def plan_of(*rows, normal=(0.0, 0.0), origin=(0.0, 0.0)):
    cells = np.array([list(row) for row in reversed(rows)])
    row, column = np.nonzero(cells == "#")
    points = CELL * (np.column_stack([column, row]) + 0.5) + origin
    return FloorPlan(
        points=points.astype(np.float32),
        normals=np.tile(np.array(normal, np.float32), (len(points), 1)),
        free=cells == ".",
        origin_xy_m=origin,
    )


def text_of(plan):
    """Draw a plan as `plan_of` reads it, without unknown cells around it."""
    cells = np.where(plan.free, ".", " ")
    column, row = plan.cells(plan.points).T
    cells[row, column] = "#"
    rows, columns = np.nonzero(cells != " ")
    cells = cells[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return ["".join(line) for line in cells[::-1]]


def scan_of(*points, origin=(0.0, 0.0)):
    return KeyScan(
        stamp_ns=0, points=np.array(points, np.float32).reshape(-1, 2), origin=np.array(origin)
    )


# Drawing.


def ray(length_m, y_m=0.025):
    """A scan of one beam along x."""
    return scan_of((0.025 + length_m, y_m), origin=(0.025, y_m))


def test_cells_up_to_shortly_before_a_wall_are_free():
    plan = draw([(np.zeros(3), ray(0.5))])
    assert text_of(plan) == ["......... #"]
    np.testing.assert_allclose(plan.points, [[0.525, 0.025]])
    np.testing.assert_allclose(plan.origin_xy_m, [-0.5, -0.5])
    assert plan.free.shape == (21, 31)  # ten cells around everything
    turned = draw([(np.array([1.0, 2.0, np.pi / 2]), ray(0.5))])
    assert text_of(turned) == ["#", " ", *"........."]
    np.testing.assert_allclose(turned.points, [[0.975, 2.525]])
    assert not len(draw([(np.zeros(3), scan_of())])) and not len(draw([]))


def test_a_wall_is_a_cell_that_enough_beams_hit():
    still = np.zeros(3)
    assert len(draw([(still, ray(0.5)), (still, ray(0.6))])) == 2
    assert len(draw([(still, ray(0.5)), (still, ray(0.6)), (still, ray(0.6))])) == 1  # of 3 scans
    for passing, walls in ((8, 2), (9, 1)):  # two hits among as many beams that pass
        scans = [ray(0.5)] * 2 + [ray(1.0)] * passing
        assert len(draw([(still, scan) for scan in scans])) == walls


def test_the_normal_of_a_cell_is_that_of_its_line_towards_the_sensor():
    wall = np.column_stack([np.full(7, 0.5), 0.06 * np.arange(-3, 4)])
    centre = np.array([0.525, 0.025])

    def normal(*yaws_rad):
        """Of one wall that scans saw at one point, from other sides."""
        poses = [np.array([*(centre - planar.rotation(yaw) @ [0.5, 0]), yaw]) for yaw in yaws_rad]
        plan = draw([(T, scan_of(wall)) for T in poses])
        return plan.normals[np.argmin(np.linalg.norm(plan.points - centre, axis=1))]

    np.testing.assert_allclose(normal(0.0), [-1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(normal(np.pi / 2), [0.0, -1.0], atol=1e-6)
    np.testing.assert_allclose(normal(0.0, 1.2), [-np.cos(0.6), -np.sin(0.6)], atol=1e-6)
    np.testing.assert_array_equal(normal(0.0, 1.4), [0.0, 0.0])  # their mean is 0.76 long


def test_a_plan_of_half_a_kilometre_is_refused():
    with pytest.raises(InputError, match="a floor plan of 1001 m x 1001 m"):
        draw([(np.zeros(3), scan_of((1000.0, 1000.0)))])


def test_joined_plans_lie_at_their_poses_and_a_wall_is_not_free():
    room = plan_of("#.", "#.", normal=(1.0, 0.0))
    turned = join([(np.array([1.0, 2.0, np.pi / 2]), room)])
    assert text_of(turned) == ["..", "##"]
    np.testing.assert_allclose(turned.normals, [[0.0, 1.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(np.sort(turned.points[:, 0]), [0.925, 0.975], atol=1e-6)
    np.testing.assert_allclose(turned.points[:, 1], 2.025, atol=1e-6)
    again = [(np.zeros(3), room), (np.array([-0.05, 0.0, 0.0]), room)]
    assert text_of(join(again)) == ["##.", "##."]
    assert not len(join([])) and not len(join([(np.zeros(3), join([]))]))


def test_a_wall_in_later_free_space_is_removed_but_not_at_its_edge():
    old, new = plan_of("#.#.#"), plan_of(*["....."] * 3)
    below = np.array([0.0, -0.05, 0.0])
    placed = [(np.zeros(3), old), (below, new)]
    assert text_of(join(placed)) == [".....", "#.#.#", "....."]
    assert text_of(join(placed, newest_wins=True)) == [".....", "#...#", "....."]
    assert text_of(join(placed[::-1], newest_wins=True)) == [".....", "#.#.#", "....."]


def test_the_grid_of_a_plan_has_the_log_odds_of_19_in_20():
    found = grid_of(plan_of("#. ", ".. "))
    np.testing.assert_array_equal(found.log_odds, [[-3, -3, 0], [3, -3, 0]])
    assert found.resolution_m == CELL and found.origin_xy_m == (0.0, 0.0)


# The nearest wall.


def test_the_nearest_wall_free_and_known_space_are_found_at_any_point():
    field = PlanField(plan_of("." * 20 + "#" + " " * 9, normal=(-1.0, 0.0), origin=(2.0, 1.0)))
    wall_x = 2.0 + 20.5 * CELL
    away_m = np.array([-0.5, -0.21, -0.19, 0.0, 0.19, 0.21, -1.1, -3.0, 40.0])
    points = np.column_stack([wall_x + away_m, np.full(9, 1.025)])
    found = field.nearest(points)
    np.testing.assert_allclose(found.distance_m, np.abs(away_m), atol=1e-6)
    np.testing.assert_allclose(found.error[:, 0], away_m, atol=1e-6)
    np.testing.assert_array_equal(found.normals, [[-1.0, 0.0]] * 9)
    assert found.is_clear.tolist() == [True, True] + [False] * 7
    assert found.is_known.tolist() == [True] * 5 + [False] * 4


def test_the_likelihood_is_one_on_a_wall_and_below_zero_in_free_space():
    field = PlanField(plan_of("." * 10 + "#" + " " * 10))
    row = field.likelihood[20, 20:41]
    np.testing.assert_allclose(field.origin_xy_m, [-1.0, -1.0])
    assert field.likelihood.shape == (41, 61)
    np.testing.assert_array_equal(row[:6], -1.0)
    expected = np.exp(-0.5 * (CELL * np.arange(11) / 0.1) ** 2)
    np.testing.assert_allclose(row[10:], expected, atol=1e-6)
    np.testing.assert_allclose(row[6:10], expected[4:0:-1], atol=1e-6)


# Registration.


def corner_of(count=40, gap_m=0.0):
    """A plan of two walls that meet at the origin, seen from inside, and free space between."""
    along = CELL * (np.arange(count) + 0.5) + gap_m
    near = np.full(count, 0.025)
    points = np.concatenate([np.column_stack([along, near]), np.column_stack([near, along])])
    free = np.zeros((count + 1, count + 1), bool)
    free[1:, 1:] = True
    return FloorPlan(
        points=points.astype(np.float32),
        normals=np.repeat(np.array([[0, 1], [1, 0]], np.float32), count, axis=0),
        free=free,
        origin_xy_m=(0.0, 0.0),
    )


def moved(plan, T_new_plan):
    """Return a plan's walls in another frame."""
    return replace(
        plan,
        points=planar.apply(T_new_plan, plan.points.astype(np.float64)).astype(np.float32),
        normals=(plan.normals @ planar.rotation(T_new_plan[2]).T).astype(np.float32),
        free=np.zeros((200, 200), bool),
        origin_xy_m=(-5.0, -5.0),
    )


def test_walls_are_registered_from_half_a_metre_away_as_certain_as_they_are_long():
    T_target_query = np.array([0.7, 0.3, 0.5])
    query = moved(corner_of(), planar.between(T_target_query, np.zeros(3)))
    start = planar.compose(np.array([0.3, -0.2, 0.1]), T_target_query)
    found = register(PlanField(query), PlanField(corner_of()), start)
    np.testing.assert_allclose(found.T_target_query, T_target_query, atol=1e-3)
    assert (found.weak_directions, found.inlier_ratio, found.known_ratio) == (0, 1.0, 1.0)
    assert found.conflict_ratio == 0.0 and found.is_verified and not found.is_refuted
    points, normals = query.points.astype(np.float64), query.normals.astype(np.float64)
    turns = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    rows = np.column_stack([normals, turns])
    one_in = 10.0 * (CELL**2 / 12.0)  # ten cells of a wall have one error, even over a cell
    x_m, y_m = points.mean(axis=0)
    from_centre = np.array([[1.0, 0.0, y_m], [0.0, 1.0, -x_m], [0.0, 0.0, 1.0]])
    common = from_centre @ np.diag([0.005, 0.005, 0.002]) ** 2 @ from_centre.T
    expected = one_in * np.linalg.inv(rows.T @ rows) + common
    np.testing.assert_allclose(found.covariance, expected, rtol=0.05, atol=2e-6)


@pytest.mark.parametrize(("across", "weak"), [(4, 0), (2, 1)])
def test_a_direction_is_held_by_three_of_a_hundred_cells_of_wall(across, weak):
    wall = corner_of(100)
    rows = np.r_[0:100, 150 : 150 + across]
    part = replace(wall, points=wall.points[rows], normals=wall.normals[rows])
    found = register(PlanField(part), PlanField(part), np.array([0.03, 0.02, 0.0]))
    assert found.weak_directions == weak
    expected = [0.0 if weak == 0 else 0.03, 0.0, 0.0]
    np.testing.assert_allclose(found.T_target_query, expected, atol=2e-3)


def test_of_two_parallel_walls_the_distant_one_weighs_less():
    wall, off_m = corner_of(60), 0.06
    points = wall.points.copy()
    points[1:60:3, 1] -= off_m  # a third of it
    found = register(PlanField(replace(wall, points=points)), PlanField(wall), np.zeros(3))
    shifts_m = np.linspace(0.0, off_m, 2001)
    near, far = ((0.01 / (0.01 + e**2)) ** 2 * e for e in (shifts_m, off_m - shifts_m))
    expected_m = shifts_m[np.argmin(np.abs(2 * near - far))]
    np.testing.assert_allclose(found.T_target_query, [0.0, expected_m, 0.0], atol=1e-3)


def test_a_bare_wall_leaves_the_motion_along_it_open():
    both = corner_of()
    wall = replace(both, points=both.points[:40], normals=both.normals[:40])
    found = register(PlanField(wall), PlanField(wall), np.array([0.1, 0.05, 0.02]))
    assert found.weak_directions == 1
    np.testing.assert_allclose(found.T_target_query, [0.1, 0.0, 0.0], atol=1e-3)
    assert found.covariance[0, 0] == pytest.approx(25.0, rel=1e-4)  # two submaps are 5 m long
    points = replace(both, normals=np.zeros_like(both.normals))
    found = register(PlanField(points), PlanField(both), np.zeros(3))
    assert found.weak_directions == 3  # points that are on no line have no direction


def test_a_wall_that_bends_away_beyond_the_end_of_the_other_does_not_pull():
    wall = corner_of()
    beyond_m = CELL * (np.arange(20) + 0.5)
    bend = np.column_stack([2.0 + beyond_m, 0.025 + 0.15 * beyond_m]).astype(np.float32)
    normals = np.tile(np.array([[-0.148, 0.989]], np.float32), (20, 1))
    query = PlanField(
        replace(
            wall,
            points=np.concatenate([wall.points, bend]),
            normals=np.concatenate([wall.normals, normals]),
            free=np.zeros((70, 70), bool),
        )
    )
    found = register(query, PlanField(wall), np.array([0.05, -0.05, 0.02]))
    np.testing.assert_allclose(found.T_target_query, np.zeros(3), atol=2e-3)


def test_the_quality_of_a_registration_is_counted_in_walls():
    wall = corner_of()
    inside = np.array([[1.0 + CELL * (i + 0.5), 1.025] for i in range(16)])
    beyond = inside - [0.0, 5.0]
    more = np.concatenate([wall.points, inside, beyond]).astype(np.float32)
    normals = np.concatenate([wall.normals, np.zeros((32, 2), np.float32)])
    query = replace(wall, points=more, normals=normals, origin_xy_m=(0.0, -5.0))
    query = replace(query, free=np.zeros((150, 50), bool))
    found = register(PlanField(query), PlanField(wall), np.zeros(3))
    assert found.known_ratio == 96 / 112  # 16 of 80 + 32 lie in space that is unknown
    assert found.inlier_ratio == 80 / 96 and found.conflict_ratio == 16 / 96
    back = register(PlanField(wall), PlanField(query), np.zeros(3))
    assert (back.known_ratio, back.inlier_ratio, back.conflict_ratio) == (1.0, 1.0, 16 / 96)


def quality(inlier_ratio=1.0, known_ratio=1.0, conflict_ratio=0.0, weak=0, at=(0.0, 0.0, 0.0)):
    return PlanRegistration(
        T_target_query=np.array(at),
        covariance=np.eye(3),
        weak_directions=weak,
        inlier_ratio=inlier_ratio,
        known_ratio=known_ratio,
        conflict_ratio=conflict_ratio,
    )


def test_a_fifth_of_the_walls_may_have_moved_and_two_fifths_refute_a_place():
    for least in (quality(inlier_ratio=0.8), quality(conflict_ratio=0.2)):
        assert least.is_verified and not least.is_refuted
    for doubtful in (0.61, 0.79):
        one, other = quality(inlier_ratio=doubtful), quality(conflict_ratio=1.0 - doubtful)
        assert not any([one.is_verified, one.is_refuted, other.is_verified, other.is_refuted])
    assert quality(inlier_ratio=0.59).is_refuted and quality(conflict_ratio=0.41).is_refuted


# The search, and the decision.


def test_a_search_finds_the_pose_of_a_plan_at_any_heading():
    search = PlanSearch(PlanField(corner_of()))
    for yaw in (0.5, -2.0, 3.0):
        T = np.array([0.7, 0.3, yaw])
        walls = moved(corner_of(), planar.between(T, np.zeros(3))).points.astype(np.float64)
        best, *others = search.find(walls, None, score_min=0.3, most=4)
        off = planar.between(T, best.T_target_query)
        assert np.hypot(off[0], off[1]) < 0.15 and abs(off[2]) < 0.08
        scores = [best.score, *(peak.score for peak in others)]
        assert len(scores) == 4 and scores == sorted(scores, reverse=True)
        assert scores[0] > 0.9 and all(0.3 <= score < 0.8 for score in scores[1:])
        found = np.array([peak.T_target_query for peak in (best, *others)])
        for row, pose in enumerate(found):
            away = found[:row] - pose
            apart = np.hypot(away[:, 0], away[:, 1]) > 0.4
            turns = np.array([planar.wrap(turn) for turn in away[:, 2]])
            assert (apart | (np.abs(turns) > 0.2)).all()
        assert len(search.find(walls, None, score_min=scores[0] - 0.05, most=4)) == 1


def test_a_search_keeps_to_its_window():
    search = PlanSearch(PlanField(corner_of()))
    T = np.array([0.7, 0.3, 0.5])
    walls = moved(corner_of(), planar.between(T, np.zeros(3))).points.astype(np.float64)
    for away, is_inside in (([0.3, 0.3, 0.1], True), ([0.6, 0.0, 0.0], False), ([0, 0, 1], False)):
        window = SearchWindow(around=T + away, half_m=0.4, half_rad=0.3)
        found = search.find(walls, window, score_min=0.8, most=4)
        assert bool(found) == is_inside
        for peak in found:
            off = peak.T_target_query - window.around
            assert np.abs(off[:2]).max() <= 0.4 and abs(off[2]) <= 0.3 + 0.15
    twice = np.concatenate([walls, walls])
    (one,) = search.find(twice, replace(window, around=T), score_min=0.8, most=4)
    assert one.score == pytest.approx(1.0, abs=1e-6)  # the mean of its walls


def recognized(monkeypatch, *found, window=None, **settings):
    """What is decided of candidates with these qualities."""
    recognizer = Recognizer(PlanField(corner_of()))
    monkeypatch.setattr(recognizer, "_candidates", lambda *_: list(found))
    return recognizer.recognize(PlanField(corner_of()), window, **settings)


def test_a_place_is_recognized_if_it_is_known_verified_and_the_only_one(monkeypatch):
    good, aside = quality(), (2.0, 0.0, 0.0)
    assert recognized(monkeypatch, good) is good and recognized(monkeypatch) is None
    assert recognized(monkeypatch, quality(known_ratio=0.6)) is not None
    assert recognized(monkeypatch, quality(known_ratio=0.59)) is None
    assert recognized(monkeypatch, quality(known_ratio=0.4), known_min=0.35) is not None
    assert recognized(monkeypatch, quality(weak=1)) is not None
    assert recognized(monkeypatch, quality(weak=2)) is None
    assert recognized(monkeypatch, quality(inlier_ratio=0.79)) is None
    rival = quality(inlier_ratio=0.86, at=aside)
    assert recognized(monkeypatch, rival, good) is None
    assert recognized(monkeypatch, good, quality(inlier_ratio=0.84, at=aside)) is good
    assert recognized(monkeypatch, good, quality(conflict_ratio=0.3, at=aside)) is None
    assert recognized(monkeypatch, good, quality(conflict_ratio=0.5, at=aside)) is good
    assert recognized(monkeypatch, replace(rival, T_target_query=np.zeros(3)), good) is good
    for at, is_apart in (((0.41, 0, 0), True), ((0.39, 0, 0), False), ((0, 0, 0.21), True)):
        found = recognized(monkeypatch, good, replace(rival, T_target_query=np.array(at)))
        assert (found is None) == is_apart
    assert recognized(monkeypatch, replace(rival, T_target_query=np.array([0, 0, 0.19])), good)


def test_the_likely_peaks_are_refined_or_the_prediction_where_it_is_near(monkeypatch):
    starts, target = [], Recognizer(PlanField(corner_of()))

    def refine(query, field, start):
        starts.append(start.tolist())
        return quality(inlier_ratio=0.0, at=start)

    monkeypatch.setattr(recognition, "register", refine)
    peaks = [Peak(T_target_query=np.full(3, x), score=x) for x in (0.9, 0.541, 0.539, 0.4)]
    limits = []
    monkeypatch.setattr(
        target._search, "find", lambda *_, **given: (limits.append(given), peaks)[1]
    )
    query, around = PlanField(corner_of()), np.array([1.0, 2.0, 3.0])
    for half_m, half_rad, is_near in (
        (0.3, 0.1, True), (0.2, 0.05, True), (0.31, 0.1, False), (0.3, 0.11, False),
    ):  # fmt: skip
        starts.clear()
        target.recognize(query, SearchWindow(around=around, half_m=half_m, half_rad=half_rad))
        assert starts == ([around.tolist()] if is_near else [[0.9] * 3, [0.541] * 3])
    starts.clear()
    assert target.recognize(query, None) is None and len(starts) == 2
    assert limits == [{"score_min": 0.3, "most": 24}] * 3


def test_two_metres_of_wall_are_recognized_and_less_are_not():
    target = Recognizer(PlanField(corner_of()))
    found = [target.recognize(PlanField(corner_of(count)), None) for count in (19, 20)]
    assert found[0] is None and found[1] is not None
