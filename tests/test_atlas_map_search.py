"""The search of a loaded map beside a run: for which poses each of its answers holds."""

from concurrent.futures import Executor, Future

import numpy as np
import pytest
from test_atlas_places import S

from sceneslam.atlas.places.localizer import Fix, LocalizationEvent, Look
from sceneslam.atlas.places.map_search import MapSearch
from sceneslam.executors import InStep
from sceneslam.types import planar, se3


def at(x_m):
    return planar.to_transform(np.array([x_m, 0.0, 0.0]))


class Told:
    """A localizer that is told where the run lies, [m] along x, from the next look on."""

    def __init__(self):
        self.x_m, self.fixes, self.piece_ns, self.pieces_ns = None, [], 0, [0]
        self.rewound, self.is_withdrawn = [], False

    @property
    def is_located(self):
        return self.x_m is not None and any(fix.piece_ns == self.piece_ns for fix in self.fixes)

    @property
    def T_map_run(self):
        return None if self.x_m is None else at(self.x_m)

    def wants_view(self, look):
        return True

    def compare(self, latest):
        if self.x_m is None and self.is_withdrawn:
            self.is_withdrawn, self.fixes = False, []
            return LocalizationEvent.WITHDRAWN
        if self.x_m is None:
            return LocalizationEvent.NOTHING
        event = LocalizationEvent.FIXED if self.is_located else LocalizationEvent.FOUND
        self.fixes.append(
            Fix(
                stamp_ns=latest[-1].stamp_ns,
                T_map_base=at(self.x_m),
                T_run_base=se3.identity(),
                covariance=np.eye(6),
                piece_ns=self.piece_ns,
            )
        )
        return event

    def restart(self, stamp_ns):
        self.piece_ns, self.x_m = stamp_ns, None
        self.pieces_ns.append(stamp_ns)

    def rewind(self, stamp_ns, path):
        self.rewound.append(stamp_ns)
        self.x_m = 9.0


class Later(Executor):
    """Runs a call when it is told to."""

    def submit(self, fn, /, *args, **kwargs):
        self.future = Future()
        self.run = lambda: self.future.set_result(fn(*args, **kwargs))
        return self.future


@pytest.fixture
def told():
    return Told()


def searching(told, executor=None, note=lambda *_, **__: None):
    return MapSearch(
        told,
        executor=executor or InStep(),
        path=lambda stamp_ns: se3.identity(),
        note=note,
    )


def look(second):
    return Look(stamp_ns=second * S, T_run_base=se3.identity(), view="a view")


def where(search, *starts_s):
    """Where submaps with these first seconds lie [m]."""
    runs = search.T_map_runs([second * S for second in starts_s])
    return [float(T[0, 3]) for T in runs]


def test_a_submap_lies_where_the_run_did_before_the_next_one_began(told):
    search = searching(told)
    for second, x_m in ((1, 1.0), (5, 2.0), (9, 3.0)):
        told.x_m = x_m
        search.look(look(second))
    assert where(search, 0, 4, 8) == [1.0, 2.0, 3.0]
    assert where(search, 0, 5, 8) == [1.0, 2.0, 3.0] and where(search) == []
    np.testing.assert_array_equal(search.T_map_run, at(3.0))


def test_an_answer_that_comes_late_holds_from_its_look_on_and_in_its_piece(told):
    later = Later()
    search = searching(told, later)
    told.x_m = 1.0
    search.look(look(1))
    later.run()
    search.collect(1 * S)
    told.x_m = 2.0
    search.look(look(15))
    search.restart(20 * S)  # while that goes on
    later.run()
    search.collect(21 * S)
    assert search.piece_ns == 20 * S and where(search, 0, 14, 20) == [1.0, 2.0, 2.0]
    told.x_m = 7.0
    search.look(look(22))
    later.run()
    search.collect(23 * S)
    assert where(search, 0, 14, 20) == [1.0, 2.0, 7.0]


def test_poses_that_are_replaced_lie_where_the_localizer_puts_them_then(told):
    search = searching(told)
    for second, x_m in ((1, 1.0), (5, 2.0)):
        told.x_m = x_m
        search.look(look(second))
    assert search.take_news() and not search.take_news()
    search.rewind(6 * S)
    search.rewind(4 * S)
    search.collect(6 * S)
    assert told.rewound == [4 * S] and search.take_news()
    assert where(search, 0, 4) == [1.0, 9.0]


def test_what_was_found_and_withdrawn_is_not_called_not_found(told):
    noted = []
    search = searching(told, note=lambda event, *_, **__: noted.append(event))
    told.x_m = 1.0
    search.look(look(1))
    told.x_m, told.is_withdrawn = None, True
    for second in (30, 61, 90):
        search.look(look(second))
    assert noted == ["relocalized", "relocalization_withdrawn"]


def test_without_a_localizer_nothing_is_found():
    search = searching(None)
    search.look(look(1))
    search.rewind(1 * S)
    search.restart(1 * S)
    search.collect(2 * S)
    assert not (search.is_placed or search.is_located or search.wants_view(look(3)))
    np.testing.assert_array_equal(search.T_map_run, np.eye(4))
