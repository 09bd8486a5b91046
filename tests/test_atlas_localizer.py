"""A run in a loaded map: where it is found by its walls, kept, and withdrawn."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_places import S, corner_of, quality, scan_of

from sceneslam.atlas.places import localizer
from sceneslam.atlas.places.localizer import LocalizationEvent, Look, MapLocalizer
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.types import planar, se3
from sceneslam.types.rig import Camera, Wheels
from sceneslam.views.placed_views import Sighting


class Scripted(Recognizer):
    """A recognizer that answers as it is told, and keeps what it was asked."""

    def __init__(self, monkeypatch):
        self.field, self.answer = PlanField(corner_of()), None
        monkeypatch.setattr(Recognizer, "of", lambda plan: self if len(plan) else None)

    def recognize(self, query, window):
        self.query, self.window = query, window
        return self.answer


def placed(second, x_m=1.0, y_m=2.0, yaw_rad=0.5):
    """The scan of one wall, dead ahead, at a pose of the run."""
    scan = scan_of(*[(0.525, 0.025)] * 2, origin=(0.025, 0.025))
    stamp_ns = round(second * S)
    return Look(
        stamp_ns=stamp_ns,
        T_run_base=planar.to_transform(np.array([x_m, y_m, yaw_rad])),
        scan=replace(scan, stamp_ns=stamp_ns),
    )


RUN_AT = np.array([1.0, 2.0, 0.5])  # where `placed` is


def in_map(T_map_run, at):
    """The pose in the map of one in the run, in the plane."""
    return planar.from_transform(T_map_run @ planar.to_transform(np.array(at)))


def located(scripted, at, run_at=(1.0, 2.0, 0.5), wheels=None):
    """A localizer that found the robot at a pose of the map after a second."""
    own, scripted.answer = MapLocalizer(corner_of(), wheels=wheels), quality(at=at)
    assert own.compare([placed(0.0, *run_at)]) is LocalizationEvent.NOTHING
    assert own.compare([placed(1.0, *run_at)]) is LocalizationEvent.FOUND
    return own


@pytest.mark.parametrize(
    ("off", "is_found"),
    [
        ((0.06, 0.06, 0.04), True),
        ((-0.09, 0.0, -0.04), True),
        ((0.11, 0.0, 0.0), False),
        ((0.0, -0.11, 0.0), False),
        ((0.0, 0.0, 0.06), False),
        ((0.0, 0.0, -0.06), False),
    ],
)
def test_a_run_is_located_where_two_searches_in_a_row_agree(monkeypatch, off, is_found):
    scripted, at = Scripted(monkeypatch), np.array([4.0, 3.0, 1.0])
    own = MapLocalizer(corner_of())
    for second, (answer, found) in enumerate(
        [
            (quality(at=at), False),
            (None, False),
            (quality(at=at), False),
            (quality(at=at, weak=1), False),
            (quality(at=at), False),
            (quality(at=planar.compose(at, np.array(off))), is_found),
        ]
    ):
        scripted.answer = answer
        expected = LocalizationEvent.FOUND if found else LocalizationEvent.NOTHING
        assert own.compare([placed(second)]) is expected
        assert (own.T_map_run is not None) == found and scripted.window is None
    if is_found:
        (fix,) = own.fixes
        assert fix.stamp_ns == 5 * S
        middle = planar.compose(at, 0.5 * np.array(off))  # as both searches are equally certain
        np.testing.assert_allclose(in_map(own.T_map_run, RUN_AT), middle, atol=1e-3)
        np.testing.assert_allclose(fix.T_map_base, planar.to_transform(middle), atol=1e-3)


def test_searches_in_vain_become_rare(monkeypatch):
    scripted = Scripted(monkeypatch)
    own, periods_s = MapLocalizer(corner_of()), [0.5] * 7 + [1.0] * 8 + [2.0] * 8 + [4.0] * 8
    assert own.is_due(placed(0.0))
    for period_s in [*periods_s, *[8.0] * 20]:
        own.compare([placed(100.0)])
        assert own.is_due(placed(100.0 + period_s)) and not own.is_due(placed(99.9 + period_s))
    scripted.answer = quality()
    own.compare([placed(100.0)])
    assert own.is_due(placed(100.5)) and not own.is_due(placed(100.4))


def test_a_located_run_is_compared_after_a_second_and_half_a_metre_or_a_third_of_a_radian(
    monkeypatch,
):
    own = located(Scripted(monkeypatch), (4.0, 3.0, 1.0))
    for moved_by, is_far in (
        ((0.49, 0.0, 0.29), False), ((0.36, -0.36, 0.0), True), ((0.0, 0.0, -0.31), True),
        ((0.0, 0.0, 0.31), True), ((-0.51, 0.0, 0.0), True), ((0.0, 0.0, 0.0), False),
    ):  # fmt: skip
        there = planar.compose(RUN_AT, np.array(moved_by))
        assert own.is_due(placed(2.0, *there)) == is_far
        assert not own.is_due(placed(1.9, *there))


@pytest.mark.parametrize("step", [(3.0, 4.0, 0.0), (0.0, 0.0, -2.0)])
def test_a_fix_lies_within_what_odometry_drifts(monkeypatch, step):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (4.0, 3.0, 1.0))
    there = planar.compose(RUN_AT, np.array(step))
    due = planar.compose(np.array([4.0, 3.0, 1.0]), np.array(step))
    half_m, half_rad = (0.15 + 0.3, 0.05 + 0.15) if step[0] else (0.15, 0.05 + 0.12)
    for off, is_fixed in (
        ([half_m + 0.01, 0, 0], False), ([0, 0, -half_rad - 0.01], False),
        ([0, half_m - 0.01, half_rad - 0.01], True),
    ):  # fmt: skip
        scripted.answer = quality(at=planar.compose(due, np.array(off)))
        event = own.compare([placed(3.0, *there)])
        assert event is (LocalizationEvent.FIXED if is_fixed else LocalizationEvent.NOTHING)
        np.testing.assert_allclose(scripted.window.around, due, atol=1e-12)
        assert scripted.window.half_m == pytest.approx(half_m)
        assert scripted.window.half_rad == pytest.approx(half_rad)
    assert [fix.stamp_ns for fix in own.fixes] == [1 * S, 3 * S]
    found = in_map(own.T_map_run, there)
    np.testing.assert_allclose(found, scripted.answer.T_target_query, atol=1e-12)


def test_a_place_that_is_contradicted_three_times_in_a_row_is_withdrawn(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))  # in front of free space
    scripted.answer = None
    unknown, nothing = placed(2.0, -5.0, -5.0, 0.0), LocalizationEvent.NOTHING
    for scan in (placed(2, 0, 0, 0), placed(3, 0, 0, 0), unknown, placed(4, 0, 0, 0)):
        assert own.compare([scan]) is nothing and own.T_map_run is not None
    assert own.compare([placed(5, 0, 0, 0)]) is nothing
    scripted.answer = quality(at=(1.0, 1.0, 0.0))
    assert own.compare([placed(6, 0, 0, 0)]) is LocalizationEvent.FIXED
    scripted.answer = None
    events = [own.compare([placed(7 + index, 0, 0, 0)]) for index in range(3)]
    assert events == [nothing, nothing, LocalizationEvent.WITHDRAWN]
    assert own.T_map_run is None and own.is_due(placed(10, 0, 0, 0))
    scripted.answer = quality(at=(1.0, 1.0, 0.0))
    assert own.compare([placed(11, 0, 0, 0)]) is nothing  # a first search


@pytest.mark.parametrize("worse", [1.0, 2.0])
def test_a_robot_that_drove_a_round_may_be_off_by_what_drifts_on_all_of_it(monkeypatch, worse):
    scripted = Scripted(monkeypatch)
    wheels = Wheels(drift_ratio=0.02 * worse, drift_rad_per_m=0.01 * worse)
    own = located(scripted, (4.0, 3.0, 1.0), wheels=wheels)
    corners = [(2.0, 0.0, 0.5), (2.0, 2.0, 1.0), (0.0, 2.0, -0.5), (0.0, 0.0, 0.0)]
    looks = [
        placed(2.0 + index, *planar.compose(RUN_AT, np.array(corner)))
        for index, corner in enumerate(corners)
    ]
    scripted.answer = None
    for count in (1, 3, 4):  # one of them is seen with the next alone
        own.compare(looks[:count])
    assert scripted.window.half_m == pytest.approx(0.15 + worse * 0.06 * 8.0)
    assert scripted.window.half_rad == pytest.approx(0.05 + worse * (0.03 * 8.0 + 0.06 * 3.0))
    scripted.answer = quality(at=(4.0, 3.0, 1.0))
    assert own.compare([placed(6.0)]) is LocalizationEvent.FIXED
    own.rewind(6 * S, lambda stamp_ns: looks[0].T_run_base)
    own.compare([placed(7.0)])
    assert scripted.window.half_m == pytest.approx(0.15 + worse * 0.06 * 2.0)  # from the first


@pytest.mark.parametrize(
    ("at", "fixes"),
    [((3.0, 1.25, 0.0), 2), ((3.0, 1.5, 0.0), 1), ((2.6, 1.0, 0.0), 1), ((3.0, 1.0, 0.3), 1)],
)
def test_fixes_stay_if_the_run_is_found_again_where_it_was_expected(monkeypatch, at, fixes):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    scripted.answer = None
    for second in (2, 3, 4):
        own.compare([placed(second, 0.0, 0.0, 0.0)])
    assert own.T_map_run is None
    scripted.answer = quality(at=np.array(at))
    said = [own.compare([placed(second, 2.0, 0.0, 0.0)]) for second in (10, 11)]
    assert said[-1] is LocalizationEvent.FOUND and own.T_map_run is not None
    assert [fix.stamp_ns / S for fix in own.fixes] == [1.0, 11.0][-fixes:]


def test_a_run_that_tilts_and_sinks_stays_where_it_was_located(monkeypatch):
    scripted, sunk = Scripted(monkeypatch), se3.exp(np.array([0.0, 0.0, -1.0, 0.1, 0.1, 0.0]))
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    look = placed(3.0, 0.0, 0.0, 0.0)
    event = own.compare([replace(look, T_run_base=look.T_run_base @ sunk)])
    assert event is LocalizationEvent.FIXED


def test_a_robot_that_was_withdrawn_stays_so_when_poses_are_replaced(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    scripted.answer = None
    for second in (2, 3, 4):
        own.compare([placed(second, 0.0, 0.0, 0.0)])
    own.rewind(3 * S, lambda stamp_ns: planar.to_transform(np.zeros(3)))
    assert own.T_map_run is None and not own.fixes


def test_walls_tell_the_place_and_the_floor_there_the_height(monkeypatch):
    scripted, climbed = Scripted(monkeypatch), np.array([0.0, 0.0, 0.4, 0.0, 0.0, 0.0])
    up = planar.to_transform(np.array([4.0, 3.0, 1.0])) @ se3.exp(climbed)
    own = MapLocalizer(corner_of(), standing=lambda T: up if T[2, 3] == 0 else T)
    scripted.answer = quality(at=np.array([4.0, 3.0, 1.0]))
    own.compare([placed(0.0)])
    assert own.compare([placed(1.0)]) is LocalizationEvent.FOUND
    np.testing.assert_allclose(own.fixes[0].T_map_base, up, atol=1e-12)
    np.testing.assert_allclose(own.T_map_run @ placed(1.0).T_run_base, up, atol=1e-12)


def test_walls_that_are_neither_right_nor_refuted_are_no_contradiction(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    scripted.answer = None
    for inlier_ratio, event in (
        (0.65, LocalizationEvent.NOTHING),
        (0.5, LocalizationEvent.WITHDRAWN),
    ):
        there = quality(inlier_ratio=inlier_ratio)
        monkeypatch.setattr(localizer, "register", lambda *_, there=there: there)
        for index in range(3):
            found = own.compare([placed(10 * inlier_ratio + index, 0, 0, 0)])
        assert found is event


@pytest.mark.parametrize(("count", "step_m", "compared"), [(10, 1.0, 7), (70, 0.06, 60)])
def test_six_metres_or_sixty_scans_are_compared(monkeypatch, count, step_m, compared):
    scripted = Scripted(monkeypatch)
    scans = [placed(0.0, 0.0, step_m * index, 0.0) for index in range(count)]
    MapLocalizer(corner_of()).compare(scans)
    walls = scripted.query.plan.points
    assert len(walls) == compared
    np.testing.assert_allclose(walls[-1], [0.525, 0.025], atol=1e-6)  # in the newest base
    np.testing.assert_allclose(walls[0], [0.525, 0.025 - step_m * (compared - 1)], atol=1e-5)


class Eyes:
    """A finder that sees the robot at a pose of the map, if it is that near."""

    def __init__(self):
        self.at, self.asked = None, []
        self.camera = Camera(size_wh=(64, 48), fx=50.0, fy=50.0, cx=32.0, cy=24.0)

    def find(self, view, expected, *, half_m, half_rad):
        self.asked.append(half_m)
        T_map_cam = planar.to_transform(self.at) @ self.camera.T_base_cam
        off = np.linalg.norm((T_map_cam - expected)[:2, 3])
        return self.recognize(view) if off <= half_m else None

    def recognize(self, view, around=None):
        pose = planar.to_transform(self.at)
        return Sighting(
            T_map_cam=pose @ self.camera.T_base_cam, covariance=np.eye(6) * 0.02**2, matches=50
        )


def seeing(monkeypatch, at):
    """A localizer whose camera sees the robot at a pose (3,), and its recognizer by walls."""
    scripted, eyes = Scripted(monkeypatch), Eyes()
    own, eyes.at = MapLocalizer(corner_of()), np.array(at)
    own._views = eyes
    return own, scripted


def seen_too(second, *run_at):
    return replace(placed(second, *run_at), view="a view")


@pytest.mark.parametrize(("weak", "expected_m"), [(0, 1.1), (1, 0.9)])
def test_walls_fix_a_run_and_eyes_where_walls_leave_a_direction_open(monkeypatch, weak, expected_m):
    """In the map, walls see it at 1.1 m, and eyes at 0.9 m."""
    scripted, eyes = Scripted(monkeypatch), Eyes()
    own = located(scripted, np.zeros(3), run_at=(0.0, 0.0, 0.0))
    own._views, eyes.at = eyes, np.array([0.9, 0.0, 0.0])
    covariance = np.diag([25.0 if weak else 1e-4, 1e-4, 1e-4])
    scripted.answer = replace(quality(at=[1.1, 0.0, 0.0], weak=weak), covariance=covariance)
    assert own.compare([seen_too(3.0, 1.0, 0.0, 0.0)]) is LocalizationEvent.FIXED
    assert in_map(own.T_map_run, [1.0, 0.0, 0.0])[0] == pytest.approx(expected_m, abs=0.01)


@pytest.mark.parametrize(("walls_m", "found_m"), [(1.0, 1.0), (None, 0.9)])
def test_where_a_view_finds_the_run_walls_fix_it(monkeypatch, walls_m, found_m):
    own, scripted = seeing(monkeypatch, [0.9, -5.0, 0.0])  # where nothing is known
    if walls_m is not None:
        at = [walls_m, -5.0, 0.0]
        monkeypatch.setattr(Scripted, "locate", lambda own, plan: None)  # not without the view
        scripted.answer = replace(quality(at=at), covariance=1e-4 * np.eye(3))
    said = [own.compare([seen_too(second, 0.0, 0.0, 0.0)]) for second in (0, 1)]
    assert said[-1] is LocalizationEvent.FOUND
    assert in_map(own.T_map_run, [0.0] * 3)[0] == pytest.approx(found_m, abs=0.01)


def test_a_view_that_walls_refute_is_as_none(monkeypatch):
    own, _ = seeing(monkeypatch, [1.0, 1.0, 0.0])  # in front of free space
    said = [own.compare([seen_too(second, 0.0, 0.0, 0.0)]) for second in (0, 1, 2)]
    assert said == [LocalizationEvent.NOTHING] * 3 and not own.is_located
    monkeypatch.setattr(Scripted, "locate", lambda own, plan: quality(at=(4.0, 3.0, 1.0)))
    looks = [seen_too(second, 0.0, 0.0, 0.0) for second in (10.0, 10.2, 10.4, 10.6, 10.8)]
    assert LocalizationEvent.FOUND in [own.compare([look]) for look in looks]
    np.testing.assert_allclose(in_map(own.T_map_run, [0.0] * 3), [4.0, 3.0, 1.0], atol=1e-9)


def test_a_view_from_a_tilted_camera_keeps_its_height_and_tilt(monkeypatch):
    own, scripted = seeing(monkeypatch, [0.0, -5.0, 0.0])
    tilted = se3.exp(np.array([0.0, -5.0, 0.1, 0.0, 0.2, 0.0]))
    monkeypatch.setattr(Scripted, "locate", lambda own, plan: None)
    at = planar.from_transform(tilted)
    scripted.answer = replace(quality(at=at), covariance=1e-4 * np.eye(3))
    own._standing = lambda T: planar.to_transform(planar.from_transform(T))
    sighting = Sighting(
        T_map_cam=tilted @ own._views.camera.T_base_cam, covariance=np.eye(6) * 4e-4, matches=50
    )
    own._views.recognize = lambda view, around=None: sighting
    for second in (1, 2):
        look = Look(stamp_ns=second * S, T_run_base=tilted, view="a view", is_level=False)
        said = own.compare([placed(0.0, 0.0, -5.0, 0.0), look])
    assert said is LocalizationEvent.FOUND
    np.testing.assert_allclose(own.T_map_run, np.eye(4), atol=1e-3)


def test_in_a_corridor_eyes_may_find_the_run_farther_off_than_walls(monkeypatch):
    """Walls that leave its length open say nothing of how far the run has drifted along it."""
    scripted, eyes = Scripted(monkeypatch), Eyes()
    own = located(scripted, np.zeros(3), run_at=(0.0, 0.0, 0.0))
    own._views = eyes
    for second in range(2, 22):
        x_m = float(second)
        scripted.answer = replace(
            quality(at=[x_m, 0.0, 0.0], weak=1), covariance=np.diag([25.0, 1e-4, 1e-4])
        )
        assert own.compare([placed(second, x_m, 0.0, 0.0)]) is LocalizationEvent.FIXED
        assert scripted.window.half_m < 0.4
    eyes.at = np.array([22.4, 0.0, 0.0])
    scripted.answer = replace(
        quality(at=[22.0, 0.0, 0.0], weak=1), covariance=np.diag([25.0, 1e-4, 1e-4])
    )
    assert own.compare([seen_too(22.0, 22.0, 0.0, 0.0)]) is LocalizationEvent.FIXED
    assert in_map(own.T_map_run, [22.0, 0.0, 0.0])[0] == pytest.approx(22.4, abs=0.01)


def test_where_a_piece_begins_the_robot_may_be_anywhere_and_earlier_places_count(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    first = own.T_map_run
    own.restart(5 * S)
    assert own.is_due(placed(5.0)) and not own.is_located  # though it is where it was located
    assert [fix.stamp_ns for fix in own.fixes] == [1 * S]
    scripted.answer = quality(at=(4.0, 3.0, 1.0))
    said = [own.compare([placed(second, 0.0, 0.0, 0.0)]) for second in (5, 6)]
    assert scripted.window is None and said[-1] is LocalizationEvent.FOUND
    np.testing.assert_allclose(in_map(own.T_map_run, [0.0] * 3), [4.0, 3.0, 1.0], atol=1e-9)
    assert [fix.stamp_ns / S for fix in own.fixes] == [1.0, 6.0]
    own.rewind(4 * S, lambda stamp_ns: se3.identity())  # before the piece: it is the first again
    assert own.is_located and [fix.stamp_ns / S for fix in own.fixes] == [1.0]
    np.testing.assert_allclose(own.T_map_run, first, atol=1e-9)


def test_a_piece_that_is_withdrawn_lies_where_the_one_before_puts_it(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    first = own.T_map_run
    own.restart(5 * S)
    scripted.answer = quality(at=(1.0, 1.2, 0.0))
    said = [own.compare([placed(second, 0.0, 0.0, 0.0)]) for second in (5, 6)]
    scripted.answer = None  # in front of free space
    said += [own.compare([placed(second, 0.0, 0.0, 0.0)]) for second in (7, 8, 9)]
    assert said[1] is LocalizationEvent.FOUND and said[-1] is LocalizationEvent.WITHDRAWN
    np.testing.assert_allclose(own.T_map_run, first, atol=1e-9)
    assert [fix.stamp_ns / S for fix in own.fixes] == [1.0]
