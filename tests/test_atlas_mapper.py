"""When a run looks for itself in a loaded map, and what is saved of it."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from test_atlas_maps import WALL, S, edge, map_of
from test_view_merge import place, viewed

from sceneslam.atlas import mapper as mapper_of
from sceneslam.atlas.lasting.saved_map import empty_map
from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.places.floor_plan import join
from sceneslam.atlas.places.localizer import Fix, LocalizationEvent
from sceneslam.atlas.submaps.collector import Known
from sceneslam.atlas.submaps.graph import LOADED, solve
from sceneslam.experiments.one_map.drive import RIG
from sceneslam.graphs.edge import EdgeKind
from sceneslam.maps.inspect import flaws
from sceneslam.types import planar, se3
from sceneslam.types.covariance import unknown_motion
from sceneslam.types.observation import LaserScan, Observation
from sceneslam.types.rig import Camera, Rig, Sensor

HERE = planar.to_transform(np.array([1.0, 2.0, 0.5]))
ASIDE = planar.to_transform(np.array([1.0, 2.0, np.pi / 2]))


class Searched:
    """A localizer that answers as it is told."""

    def __init__(self, monkeypatch):
        monkeypatch.setattr(mapper_of, "MapLocalizer", self._made)
        self.wants_view = lambda look: False
        self.T_map_run, self.fixes, self.is_late = None, [], False
        self.answer, self.asked = LocalizationEvent.NOTHING, []
        self.piece_ns, self.pieces_ns = 0, [0]
        self.is_located = False

    def _made(self, plan, views, *, standing, wheels):
        self.standing = standing
        return self

    def is_due(self, look):
        return not self.is_late

    def compare(self, latest):
        self.asked.append([look.stamp_ns / S for look in latest])
        self.is_located = self.T_map_run is not None
        if self.is_located and (not self.fixes or self.answer is LocalizationEvent.FIXED):
            T, at = latest[-1].T_run_base, latest[-1].stamp_ns
            fix = Fix(
                stamp_ns=at,
                T_map_base=self.T_map_run @ T,
                T_run_base=T,
                covariance=1e-4 * np.eye(6),
            )
            self.fixes.append(fix)
        return self.answer


SCAN = LaserScan(
    stamp_ns=0,
    ranges_m=np.full(20, 2.0, np.float32),
    angle_min_rad=-1.0,
    angle_step_rad=0.1,
    range_min_m=0.1,
    range_max_m=9.0,
)


def looking(speed_m_s=0.0):
    """A run with a loaded map, and its events; `observe` takes a second."""
    events = []
    own = Mapper(
        RIG,
        known=lambda stamp_ns: Known(
            T_map_base=planar.to_transform(np.array([speed_m_s * stamp_ns / S, 0, 0])),
            session=0,
            module="a",
            covariance=None,
        ),
        note=lambda *event, **fields: events.append((*event, fields)),
        loaded=map_of(WALL, pieces=[0]),
    )

    def observe(second):
        stamp_ns = round(second * S)
        scan = replace(SCAN, stamp_ns=stamp_ns)
        own.observe(Observation(stamp_ns=stamp_ns, scan=scan), None)

    return own, events, observe


def test_a_robot_at_rest_searches_once_a_second_until_it_was_located(monkeypatch):
    searched = Searched(monkeypatch)
    own, events, observe = looking()
    for second in (1.0, 1.5, 1.9, 2.0, 2.5, 3.0):
        observe(second)
    assert searched.asked == [[1.0], [1.0, 2.0], [1.0, 2.0, 3.0]]
    assert not own.is_found and not own.is_placed
    searched.answer, searched.T_map_run = LocalizationEvent.FOUND, HERE
    observe(4.0)
    expected = {"after_s": 3.0, "T_map_run": HERE.tolist()}
    assert events == [("relocalized", 4 * S, expected)]
    assert own.is_found and own.is_placed
    np.testing.assert_array_equal(own.T_map_run, HERE)
    observe(9.0)
    assert len(searched.asked) == 4


def test_a_located_run_stands_on_the_floor_of_the_loaded_map(monkeypatch):
    searched = Searched(monkeypatch)
    looking()
    sunk = HERE @ se3.exp(np.array([0.0, 0.0, -0.3, 0.1, 0.0, 0.0]))
    np.testing.assert_allclose(searched.standing(sunk)[2], [0.0, 0.0, 1.0, 0.0], atol=1e-12)


def test_a_run_tells_once_after_five_seconds_that_it_was_not_located(monkeypatch):
    searched = Searched(monkeypatch)
    _, events, observe = looking(speed_m_s=1.0)
    for second in (1.0, 2.0, 5.9, 6.1, 7.0):
        observe(second)
    assert events == [("not_relocalized", round(6.1 * S), {"after_s": pytest.approx(5.1)})]
    searched.answer, searched.T_map_run = LocalizationEvent.WITHDRAWN, None
    observe(8.0)
    assert events[1:] == [("relocalization_withdrawn", 8 * S, {"after_s": 7.0})]


CAMERA = Camera(size_wh=(640, 480), fx=500.0, fy=500.0, cx=320.0, cy=240.0)
SEEING = Rig(sensors=frozenset({Sensor.IMAGE}), camera=CAMERA)
WALLS = map_of(WALL)
VIEWS = viewed(map_of(join([])), [(se3.identity(), place(1))])


@pytest.mark.parametrize(
    ("rig", "loaded", "why"),
    [
        (RIG, VIEWS, "the robot has no sensor for the views in it"),
        (SEEING, WALLS, "the robot has no sensor for the walls in it"),
        (Rig(sensors=frozenset()), viewed(WALLS, [(se3.identity(), place(1))]), "walls and views"),
        (RIG, map_of(join([])), "it shows neither walls nor views"),
        (RIG, WALLS, None),
        (SEEING, VIEWS, None),
        (RIG, empty_map(), None),
    ],
)
def test_a_map_that_no_sensor_can_recognize_is_told_at_the_start(rig, loaded, why):
    events = []

    def note(*event, **fields):
        events.append((*event, fields))

    Mapper(rig, known=lambda stamp_ns: None, note=note, loaded=loaded)
    if why is None:
        assert events == []
    else:
        ((kind, stamp_ns, fields),) = events
        assert (kind, stamp_ns) == ("warning", 0)
        assert "the run will not be found in the loaded map" in fields["what"]
        assert why in fields["what"]


class Busy(Executor):
    """Runs its calls when it is shut down."""

    def __init__(self):
        self.waiting = []

    def submit(self, function, *args, **kwargs):
        self.waiting.append((Future(), partial(function, *args, **kwargs)))
        return self.waiting[-1][0]

    def shutdown(self, **_):
        for future, call in self.waiting:
            future.set_result(call())


def test_what_a_live_run_finds_by_its_last_search_counts(monkeypatch):
    searched = Searched(monkeypatch)
    own, events, observe = looking(speed_m_s=1.0)
    own._executor = own._search._executor = Busy()
    observe(1.0)
    searched.answer, searched.T_map_run = LocalizationEvent.FOUND, HERE
    correction = own.finish(lambda stamp_ns: None, [])
    assert [event for event, *_ in events] == ["relocalized"] and own.is_found
    np.testing.assert_allclose(correction.T_new_old, [HERE])


def test_the_newest_eighty_scans_are_compared_when_it_is_due(monkeypatch):
    searched = Searched(monkeypatch)
    _, _, observe = looking(speed_m_s=1.0)
    searched.is_late = True
    for second in range(100):
        observe(second)
    assert searched.asked == []
    searched.is_late = False
    observe(100)
    assert searched.asked == [list(range(21, 101))]


def test_a_run_is_saved_as_a_piece_of_its_own_until_it_was_located(monkeypatch):
    searched = Searched(monkeypatch)
    own, _, observe = looking(speed_m_s=1.0)
    for second in range(60):
        observe(second)
    saved = own.saved()
    assert saved.pieces[0] == 0 and (saved.pieces[1:] == 1).all() and len(saved.pieces) > 5
    assert [submap.run for submap in saved.submaps[:3]] == [0, 1, 1]
    assert [(one.first, one.second) for one in saved.edges[:2]] == [(1, 2), (2, 3)]
    step = saved.plane[2] - saved.plane[1]
    searched.answer, searched.T_map_run = LocalizationEvent.FOUND, ASIDE
    observe(60)
    saved = own.saved()
    assert (saved.pieces == 0).all()
    np.testing.assert_allclose(saved.plane[1], [1.0, 2.0, np.pi / 2], atol=1e-9)
    np.testing.assert_allclose(saved.plane[2], [1.0, 2.0 + step[0], np.pi / 2], atol=1e-9)


def test_loops_lead_between_the_middles_of_submaps_or_from_the_loaded_map(monkeypatch):
    Searched(monkeypatch)
    own, _, observe = looking(speed_m_s=1.0)
    for second in range(60):
        observe(second)
    own._collector.finish()
    starts_s = [int(submap.stamps_ns[0]) // S for submap in own._collector.chain.submaps]
    assert starts_s[:3] == [0, 3, 6] and starts_s[-1] == 57
    loops = edge(0, 3), edge(2, 20, (1, 0, 0), EdgeKind.LOOP)
    own._solved = replace(own._solved, loops=loops)
    found = own.loops(np.arange(60) * S)
    assert [(loop.first, loop.second) for loop in found] == [(LOADED, 7), (4, 58)]
    for loop, measured, x_m in zip(found, loops, (2.0, 1.0), strict=True):  # a middle is at 1 m
        np.testing.assert_allclose(loop.T_first_second, se3.from_xy_yaw(x_m, 0.0, 0.0))
        swung = loop.covariance[1, 1] - measured.covariance[1, 1]
        assert swung == pytest.approx(measured.covariance[5, 5])


def test_a_map_is_saved_as_the_graph_moved_it_with_the_loops_that_modules_closed(monkeypatch):
    Searched(monkeypatch)
    own, _, observe = looking(speed_m_s=1.0)
    for second in range(20):
        observe(second)
    own_loops, moved = (edge(1, 5, kind=EdgeKind.LOOP),), np.array([ASIDE])
    wrong = edge(1, 3, (50.0, 0.0, 0.0), EdgeKind.LOOP)
    own._solved = replace(own._solved, T_map_loaded=moved, own_loops=own_loops, loops=(wrong,))
    chain = own._collector.chain
    chain.submaps = [replace(submap, up=np.array([0.0, 0.6, 0.8])) for submap in chain.submaps]
    assert own.saved().edges[-1] == wrong
    nodes = chain.T_run_node
    fitting = replace(own_loops[0], T_first_second=se3.inverse(nodes[0]) @ nodes[4])
    own._solved, own._is_over = replace(own._solved, own_loops=(fitting,)), True
    saved, own_loops = own.saved(), (fitting,)
    np.testing.assert_allclose(
        [one.up for one in saved.submaps[1:]], [[0, 0, 1]] * len(nodes), atol=1e-9
    )
    np.testing.assert_array_equal(saved.T_map_node[0], ASIDE)
    assert saved.edges[-1] == own_loops[0] and len(saved.edges) == len(saved.submaps) - 1


def test_a_gap_that_loops_bridge_is_saved_without_the_guess_that_the_robot_stood_still(
    monkeypatch,
):
    Searched(monkeypatch)
    own, _, observe = looking(speed_m_s=1.0)
    for second in range(20):
        observe(second)
    chain = own._collector.chain
    seam = chain.motions[1]
    covariance = seam.covariance + unknown_motion(1.0)
    chain.motions[1] = replace(seam, covariance=covariance, kind=EdgeKind.HANDOVER)
    carried = planar.to_transform(np.array([0.0, 40.0, np.pi / 2]))
    nodes = np.array([*chain.T_run_node[:2], *(carried @ T for T in chain.T_run_node[2:])])
    loops = [
        replace(edge(a, b, kind=EdgeKind.LOOP), T_first_second=se3.inverse(nodes[a]) @ nodes[b])
        for a, b in ((0, 4), (1, 5))
    ]
    found = tuple(loop.shifted(1) for loop in loops)
    own._solved, own._is_over = replace(own._solved, T_map_node=nodes, loops=found), True
    saved = own.saved()
    assert (saved.pieces[1:] == 1).all() and flaws(saved) == []
    moving = saved.moving(saved.nodes(1))
    held = {"fixed": moving.fixed, "loose": moving.loose}
    solved = solve(saved.T_map_node, moving.motions, (), places=moving.loops, **held)
    np.testing.assert_allclose(solved.T_map_node, saved.T_map_node, atol=0.01)


def test_a_submap_stays_where_the_run_was_located_then(monkeypatch):
    searched = Searched(monkeypatch)
    own, _, observe = looking(speed_m_s=1.0)  # a submap every 3 m
    searched.answer, searched.T_map_run = LocalizationEvent.FOUND, HERE
    for second in range(8):
        observe(second)
    first = own.take_correction()
    assert len(first.stamps_ns) == len(own.saved().submaps) - 1 >= 2
    np.testing.assert_array_equal(first.T_new_old, [HERE] * len(first.stamps_ns))
    searched.answer, searched.T_map_run = LocalizationEvent.FIXED, ASIDE
    for second in range(8, 14):
        observe(second)
    second = own.take_correction()
    old = len(first.stamps_ns)
    assert len(second.stamps_ns) > old
    np.testing.assert_array_equal(second.T_new_old[:old], [HERE] * old)
    np.testing.assert_array_equal(second.T_new_old[old:], [ASIDE] * (len(second.stamps_ns) - old))
    nodes = own.saved().T_map_node[1:]
    np.testing.assert_allclose(nodes[0], HERE, atol=1e-12)
    np.testing.assert_allclose(nodes[-1][:2, :2], ASIDE[:2, :2], atol=1e-12)
    searched.answer, searched.T_map_run = LocalizationEvent.FOUND, HERE
    observe(14)
    found = own.take_correction()
    np.testing.assert_array_equal(found.T_new_old, [HERE] * len(found.stamps_ns))


@pytest.mark.parametrize("is_placed", [True, False])
def test_a_located_run_is_corrected_into_the_loaded_map(monkeypatch, is_placed):
    searched = Searched(monkeypatch)
    own, events, observe = looking(speed_m_s=1.0)
    for second in range(20):
        observe(second)
    if is_placed:
        searched.answer, searched.T_map_run = LocalizationEvent.FOUND, HERE
        observe(20)
    kept = len(events)
    path = lambda stamp_ns: planar.to_transform(np.array([stamp_ns / S, 0.0, 0.0]))  # noqa: E731
    found = own.finish(path, [])
    assert (
        len(found.stamps_ns) == (7 if is_placed else 0)
        and [event for event, *_ in events[kept:]] == ["loop"] * is_placed
    )
    stamps_ns = np.arange(20) * S
    poses = np.stack([path(stamp_ns) for stamp_ns in stamps_ns])
    np.testing.assert_allclose(found.apply(stamps_ns, poses), own.T_map_run @ poses, atol=1e-9)
    assert (own.saved().pieces == (0 if is_placed else np.r_[0, [1] * 7])).all()


@pytest.mark.parametrize("off_m", [0.0, 3.0])
def test_a_map_that_is_saved_during_the_run_says_where_that_lies_in_the_loaded_map(
    monkeypatch, off_m
):
    """A run that is killed is connected with the map, but for places that it contradicts."""
    searched = Searched(monkeypatch)
    own, _, observe = looking(speed_m_s=1.0)
    for second in range(20):
        observe(second)
    assert not any(edge.is_loop for edge in own.saved().edges)
    T_run_base = planar.to_transform(np.array([12.0, 0.0, 0.0]))
    fix = Fix(
        stamp_ns=12 * S,
        T_map_base=HERE @ planar.to_transform(np.array([12.0, off_m, 0.0])),
        T_run_base=T_run_base,
        covariance=1e-4 * np.eye(6),
    )
    searched.fixes, searched.T_map_run = [fix], HERE
    searched.answer = LocalizationEvent.FOUND
    observe(20)
    places = [edge for edge in own.saved().edges if edge.is_loop]
    if off_m:
        assert places == []
        return
    (place,) = places
    found = own.saved().T_map_node
    T_first_second = se3.inverse(found[place.first]) @ found[place.second]
    np.testing.assert_allclose(place.T_first_second, T_first_second, atol=1e-9)
    assert place.first == 0 and own.saved().pieces[place.second] == 0
