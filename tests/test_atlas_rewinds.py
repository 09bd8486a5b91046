"""Submaps whose poses a hand-over replaces: they are those of the poses as they are at the end."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_atlas_mapper import SCAN
from test_atlas_maps import WALL, edge, map_of
from test_atlas_submaps import RIG, S, at, unseen

from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.submaps.collector import Collector, Known
from sceneslam.atlas.submaps.run_graph import RunGraph, SolvedRun
from sceneslam.experiments.one_map.drive import RIG as SCANNING
from sceneslam.graphs.edge import EdgeKind
from sceneslam.types.covariance import unknown_motion
from sceneslam.types.observation import Observation


class Path:
    """Poses by stamp, which may be replaced."""

    def __init__(self):
        self.known = {}

    def put(self, stamp_ns, x_m, session=0):
        self.known[stamp_ns] = Known(
            T_map_base=at(x_m, 0.1 * session, 0.01 * session),
            session=session,
            module="a",
            covariance=None,
        )

    def __call__(self, stamp_ns):
        return self.known.get(stamp_ns)


def up_at(stamp_ns):
    """Every third second the vertical direction is measured."""
    return None if stamp_ns // S % 3 else np.array([0.001 * (stamp_ns // S), 0.0, 1.0])


def added(path, stamps_ns=()):
    own = Collector(RIG, path, 0, unseen)
    for stamp_ns in stamps_ns:
        own.add(stamp_ns, None, up_at(stamp_ns))
    return own


def steps(count):
    """A path of so many steps of 0.5 m, one a second, and the submaps of it: six steps each."""
    path = Path()
    for index in range(count):
        path.put(index * S, 0.5 * index)
    return path, added(path, path.known)


def assert_same(one, other):
    """Assert that two chains are the same, to the bit."""
    assert len(one) == len(other)
    for a, b in zip(one.submaps, other.submaps, strict=True):
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
        np.testing.assert_array_equal(a.T_submap_base, b.T_submap_base)
        assert (a.run, a.session, a.module) == (b.run, b.session, b.module)
        np.testing.assert_array_equal(a.up, b.up)
    for a, b in zip(one.motions, other.motions, strict=True):
        assert (a.first, a.second, a.kind) == (b.first, b.second, b.kind)
        np.testing.assert_array_equal(a.T_first_second, b.T_first_second)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    np.testing.assert_array_equal(one.T_run_node, other.T_run_node)
    np.testing.assert_array_equal(one.drift, other.drift)


_AHEAD = st.tuples(
    st.integers(1, 4),  # seconds
    st.sampled_from([0.1, 0.4, 0.9, 2.6]),  # metres
    st.sampled_from([0, 0, 0, 1]),  # a new session
    st.lists(
        st.tuples(st.integers(0, 12), st.sampled_from([0.5, 1.0, 1.7]), st.integers(0, 1)),
        max_size=2,
    ),
)


@given(st.lists(_AHEAD, min_size=1, max_size=40))
def test_submaps_are_those_of_the_last_poses_whatever_was_rewound(drive):
    path, stamp_ns, x_m, session = Path(), 0, 0.0, 0
    own = added(path)
    for after_s, ahead_m, is_new, rewinds in drive:
        stamp_ns, x_m, session = stamp_ns + after_s * S, x_m + ahead_m, session + is_new
        path.put(stamp_ns, x_m, session)
        own.add(stamp_ns, None, up_at(stamp_ns))
        for back_s, scale, is_other in rewinds:  # all before the next step
            since_ns, session = stamp_ns - back_s * S, session + is_other
            own.rewind(since_ns)
            gone = [ns for ns in path.known if ns >= since_ns]
            kept = [ns for ns in path.known if ns < since_ns][-1:] or gone[:1]
            start_m = path.known[kept[0]].T_map_base[0, 3]
            for ns in gone:
                x_m = start_m + scale * (path.known[ns].T_map_base[0, 3] - start_m)
                path.put(ns, x_m, session)
    own.finish()
    once = added(path, path.known)
    once.finish()
    assert_same(own.chain, once.chain)


def test_a_rewind_within_the_open_submap_leaves_those_that_are_complete():
    _, own = steps(16)
    first, second = own.chain.submaps
    own.rewind(14 * S)
    assert own.chain.submaps == [first, second] and len(own.chain.motions) == 1
    own.rewind(16 * S)  # nothing is newer
    own.finish()
    assert [len(one.stamps_ns) for one in own.chain.submaps] == [6, 6, 4]


def test_a_rewind_removes_submaps_and_what_was_measured_between_them_at_once():
    path, own = steps(28)
    first, *_ = own.chain.submaps
    assert (len(own.chain), len(own.chain.motions)) == (4, 3)
    assert all(submap.up is not None for submap in own.chain.submaps)
    own.rewind(9 * S)
    assert own.chain.submaps == [first] and own.chain.motions == []
    assert len(own.chain.T_run_node) == len(own.chain.drift) == 1 and own.chain.is_upright
    own.rewind(10 * S)  # once more, before poses came
    assert own.chain.submaps == [first]
    for index in range(9, 28):
        path.put(index * S, 4.5 + 0.25 * (index - 9))  # slower
    own.finish()
    assert [len(one.stamps_ns) for one in own.chain.submaps] == [6, 8, 11, 3]


def test_a_piece_begins_with_each_later_session_also_with_one_that_comes_again():
    """Bridged poses that replace all of a session's belong to the one before it again."""
    own, begun = added(lambda stamp_ns: None), []
    for second, session in enumerate((-1, 0, 1, 2, 1, 1, 2, 2, 0, 3)):
        T, of_map = at(0.1 * second), unknown_motion(5.0)
        known = Known(T_map_base=T, session=session, module="a", covariance=None, of_map=of_map)
        begun.append(own.has_begun(known))
    assert begun == [False, True, True, True, False, False, True, False, False, True]


def test_a_rewind_to_before_the_run_leaves_nothing_until_poses_come():
    path, own = steps(15)
    before = added(path, path.known)
    own.rewind(-S)
    assert len(own.chain) == 0 and own.chain.motions == [] and not own.chain.is_upright
    for each in (own, before):
        each.finish()
    assert_same(own.chain, before.chain)


def test_steps_that_have_no_pose_any_more_belong_to_no_submap():
    path, own = steps(15)
    own.rewind(10 * S)
    for index in range(10, 14):
        del path.known[index * S]
    own.finish()
    assert [ns // S for one in own.chain.submaps for ns in one.stamps_ns] == [*range(10), 14]


def test_submaps_that_no_handover_replaces_stay():
    _, own = steps(60)
    old = list(own.chain.submaps)
    own.rewind(0)
    kept = len(own.chain)
    assert own.chain.submaps == old[:kept] and len(own.chain.motions) == kept - 1
    assert old[-1].stamps_ns[-1] == 53 * S  # 20 s after the last one that stays
    assert [one.stamps_ns[-1] // S for one in old[kept - 1 : kept + 1]] == [29, 35]


def test_a_short_submap_after_a_slow_one_leaves_both_to_be_replaced():
    path = Path()
    seconds = [*range(0, 12), *range(14, 44, 5), 45, 46, 47]
    for index, second in enumerate(seconds):
        path.put(second * S, 0.5 * index, session=int(second >= 45) + int(second >= 46))
    own = added(path, path.known)
    assert [one.stamps_ns[-1] // S for one in own.chain.submaps] == [5, 11, 39, 45]
    own.rewind(36 * S)
    assert [one.stamps_ns[-1] // S for one in own.chain.submaps] == [5, 11]


# While the run goes on.


class Driving:
    """A mapper at 1 m/s: a submap holds three steps; and its events."""

    def __init__(self, *, loaded=None, is_live=False):
        self.events, self.path = [], Path()
        self.own = Mapper(
            SCANNING,
            known=self.path,
            note=lambda event, stamp_ns, **fields: self.events.append((event, stamp_ns, fields)),
            loaded=loaded,
            is_live=is_live,
        )

    def to(self, *seconds, session=0):
        for second in seconds:
            self.path.put(second * S, float(second), session)
            scan = replace(SCAN, stamp_ns=second * S)
            self.own.observe(Observation(stamp_ns=second * S, scan=scan), None)

    def rewind(self, second):
        """Replace the poses from a second on by those of another session."""
        self.own.rewind(second * S)
        for ns in [ns for ns in self.path.known if ns >= second * S]:
            self.path.put(ns, ns / S, session=1)

    def told(self, what="loop"):
        """Return the seconds of the loops that were found, or of those `loop_withdrawn`."""
        return [ns // S for event, ns, _ in self.events if event == what]

    def finish(self):
        return self.own.finish(lambda ns: self.path.known[ns].T_map_base, [])


def test_a_scan_after_a_handover_lies_as_the_replaced_poses_moved():
    """It drives at 0.5 m/s, 0.1 m beside them; the middle of a sweep is 50 ms ahead."""
    path, step_ns = Path(), S // 10
    own = Mapper(SCANNING, known=path, note=lambda *_, **__: None)
    for index in range(16):
        if index == 15:
            own.rewind(8 * step_ns)
            for row in range(8, 15):
                path.put(row * step_ns, 0.05 * row, session=1)
        path.put(index * step_ns, 0.05 * index, session=index // 15)
        own.observe(Observation(stamp_ns=index * step_ns), None)
    T_base_then = own._trail.base_at(15 * step_ns + step_ns // 2)
    np.testing.assert_allclose(T_base_then, at(0.025), atol=1e-3)


class Solving:
    """A graph that finds a loop between the ends of what it is given, and moves all by 1 m."""

    def __init__(self, monkeypatch):
        self.kept, self.lengths, self.threads = [], [], []
        self.may_go_on, self.found = threading.Event(), True
        self.may_go_on.set()
        monkeypatch.setattr(RunGraph, "extend", lambda own, chain, **_: self.extend(own, chain))
        monkeypatch.setattr(RunGraph, "forget", lambda own, count: self.kept.append(count))

    def wait(self, drive):
        """Let what the graph is busy with end, and only that."""
        self.may_go_on.set()
        drive.own._solving[1].result()
        self.may_go_on.clear()

    def extend(self, own, chain):
        self.lengths.append(len(chain))
        self.threads.append(threading.current_thread())
        assert self.may_go_on.wait(60.0)
        if isinstance(self.found, Exception):
            raise self.found
        loop = replace(edge(0, len(chain) - 1), kind=EdgeKind.LOOP).shifted(own._count)
        return SolvedRun(
            T_map_node=at(0.0, 1.0) @ np.array(chain.T_run_node),
            loops=(loop,) if self.found else (),
        )


def test_the_newest_pose_is_corrected_by_loops_and_each_is_reported_once(monkeypatch):
    solving, drive = Solving(monkeypatch), Driving()
    drive.to(*range(4))
    np.testing.assert_allclose(drive.own.take_correction().T_new_old, [at(0.0, 1.0)], atol=1e-12)
    assert drive.own.take_correction() is None
    drive.to(*range(4, 7))
    assert solving.lengths == [1, 2] and solving.threads == [threading.main_thread()] * 2
    assert drive.told() == [0, 3]
    assert drive.events[-1][2]["to_ns"] == 0 and not drive.events[-1][2]["in_loaded_map"]
    solving.found = False
    drive.to(*range(7, 10))
    after = drive.own.take_correction()  # its loops are not believed any more
    np.testing.assert_array_equal(after.T_new_old, [at()] * 3)
    assert (after.stamps_ns // S).tolist() == [0, 3, 6]
    assert drive.told() == drive.told("loop_withdrawn") == [0, 3]


def test_a_rewind_that_takes_the_last_loops_takes_their_correction(monkeypatch):
    solving, drive = Solving(monkeypatch), Driving()
    drive.to(*range(7))
    assert drive.own.take_correction() is not None
    solving.found = False
    drive.rewind(0)
    drive.to(7, 8, 9, session=1)
    after = drive.own.take_correction()
    np.testing.assert_array_equal(after.T_new_old, [at()] * len(after.stamps_ns))


def test_loops_of_a_run_are_counted_after_the_loaded_map_and_lead_between_its_submaps(monkeypatch):
    Solving(monkeypatch)
    drive = Driving(loaded=map_of(WALL, WALL, pieces=[0, 0]))
    drive.to(*range(7))
    _, (_, second_ns, second) = [one for one in drive.events if one[0] == "loop"]
    assert (second_ns, second["to_ns"], second["in_loaded_map"]) == (3 * S, 0, False)
    assert drive.own.saved().edges[-1].second == 3
    drive.own.rewind(5 * S)
    assert len(drive.own.saved().submaps) == 3
    assert all(edge.second < 3 for edge in drive.own.saved().edges)


def test_a_loop_that_is_found_again_after_a_rewind_is_reported_only_if_it_is_another(monkeypatch):
    Solving(monkeypatch)
    drive = Driving()
    drive.to(*range(7))
    drive.rewind(3)
    drive.to(7, 8, session=1)  # the second submap begins at 3 s again
    assert drive.told() == [0, 3]
    drive.own.rewind(4 * S)
    for second in range(4, 9):
        drive.path.put(second * S, second, session=2)
    drive.to(9, session=2)
    assert drive.told() == [0, 3, 4]


def test_what_was_solved_of_poses_that_were_replaced_meanwhile_is_not_used(monkeypatch):
    solving, drive = Solving(monkeypatch), Driving(is_live=True)
    solving.may_go_on.clear()
    drive.to(*range(4))
    solving.wait(drive)
    drive.to(4)
    assert drive.told() == [0]
    drive.to(5, 6, 7)
    drive.rewind(5)
    drive.to(8, session=1)  # it is not waited for
    assert len(drive.own._collector.chain) == 3
    solving.wait(drive)
    drive.to(9, session=1)
    assert drive.told() == [0]
    solving.wait(drive)
    drive.to(10, session=1)
    assert drive.told() == [0, 5]
    assert solving.lengths == [1, 2, 3] and solving.kept == [0, 1, 1]
    assert threading.main_thread() not in solving.threads
    solving.may_go_on.set()
    drive.own._executor.shutdown()


def test_a_graph_that_is_busy_is_given_all_submaps_as_soon_as_it_is_not(monkeypatch):
    solving, drive = Solving(monkeypatch), Driving(is_live=True)
    solving.may_go_on.clear()
    drive.to(*range(13))
    solving.wait(drive)
    drive.to(13)
    solving.may_go_on.set()
    drive.own._executor.shutdown()
    assert solving.lengths == [1, 4]


@pytest.mark.parametrize("is_last", [False, True])
def test_a_graph_that_fails_in_its_thread_is_named_once_and_not_asked_again(monkeypatch, is_last):
    solving, drive = Solving(monkeypatch), Driving(is_live=True)
    solving.found = ValueError("no graph")
    solving.may_go_on.clear()
    drive.to(*range(4))
    solving.may_go_on.set()
    if not is_last:
        drive.own._executor.shutdown()
        drive.to(*range(4, 9))
    drive.finish()
    (fault,) = drive.own.faults
    assert fault.startswith("the graph of the run gets no further loops") and "no graph" in fault
    assert solving.lengths == [1]
