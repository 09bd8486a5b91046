"""A run of two pieces in a loaded map: each is located, withdrawn, corrected and saved alone."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_localizer import Scripted, located, placed
from test_atlas_mapper import RIG, SCAN, WALL, S, map_of
from test_atlas_places import quality

from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.submaps.collector import Known
from sceneslam.types import planar, se3
from sceneslam.types.covariance import unknown_motion
from sceneslam.types.observation import Observation

SEAM_S, LAST_S = 20, 40
FIRST, SECOND = np.array([-2.0, 1.0, 0.0]), np.array([3.0, 4.0, 1.0])  # T_map_run of the pieces


def path(stamp_ns):
    """The run drives straight on at 1 m/s."""
    return planar.to_transform(np.array([stamp_ns / S, 0.0, 0.0]))


class Run:
    """A run in a loaded map; the recognizer answers by `T_map_run` (3,), None: nothing."""

    def __init__(self, monkeypatch):
        self.scripted = Scripted(monkeypatch)
        monkeypatch.setattr(Scripted, "locate", lambda own, plan: own.answer)
        self.mapper = Mapper(
            RIG, known=self._known, note=lambda *_, **__: None, loaded=map_of(WALL, pieces=[0])
        )
        self.T_new_old = None

    def drive(self, from_s, to_s, T_map_run):
        for stamp_ns in range(round(from_s * S), round(to_s * S), S // 5):
            at = planar.from_transform(path(stamp_ns))
            self.scripted.answer = None if T_map_run is None else self._seen(T_map_run, at)
            scan = replace(SCAN, stamp_ns=stamp_ns)
            self.mapper.observe(Observation(stamp_ns=stamp_ns, scan=scan), None)
            self.T_new_old = self.mapper.take_correction() or self.T_new_old
        return self

    @staticmethod
    def _seen(T_map_run, at):
        return replace(quality(at=planar.compose(T_map_run, at)), covariance=1e-4 * np.eye(3))

    @staticmethod
    def _known(stamp_ns):
        is_second = stamp_ns >= SEAM_S * S
        return Known(
            T_map_base=path(stamp_ns),
            session=int(is_second),
            module="a",
            covariance=None,
            of_map=unknown_motion(5.0) if is_second else np.zeros((6, 6)),
            begun_ns=SEAM_S * S if is_second else 0,
        )

    def moved(self, correction, second):
        """T_map_run (3,) that a correction has at a second."""
        stamp_ns = round(second * S)
        pose = path(stamp_ns)
        (moved,) = correction.apply(np.array([stamp_ns]), pose[None])
        return planar.from_transform(moved @ se3.inverse(pose))


def test_each_piece_lies_where_it_was_located_while_it_goes_on_and_at_the_end(monkeypatch):
    run = Run(monkeypatch).drive(0, SEAM_S, FIRST).drive(SEAM_S, LAST_S, SECOND)
    final = run.mapper.finish(path, [])
    for correction in (run.T_new_old, final):
        for second, expected in ((5.0, FIRST), (19.9, FIRST), (25.0, SECOND), (35.0, SECOND)):
            np.testing.assert_allclose(run.moved(correction, second), expected, atol=0.02)
    assert not run.mapper.saved().pieces.any()


def test_of_a_graph_that_fails_each_piece_stays_where_it_was_located(monkeypatch):
    run = Run(monkeypatch).drive(0, SEAM_S, FIRST).drive(SEAM_S, LAST_S, SECOND)
    monkeypatch.setattr(run.mapper._graph, "finish", None)
    final = run.mapper.finish(path, [])
    np.testing.assert_allclose(run.moved(final, 5.0), FIRST, atol=0.02)
    np.testing.assert_allclose(run.moved(final, 35.0), SECOND, atol=0.02)
    assert run.mapper.faults and not run.mapper.saved().pieces.any()


def test_a_piece_that_was_not_located_is_saved_apart_also_while_the_next_one_begins(monkeypatch):
    run = Run(monkeypatch).drive(0, SEAM_S, None)
    for tenth in range(10 * SEAM_S, 10 * SEAM_S + 60, 2):
        run.drive(tenth / 10, (tenth + 2) / 10, SECOND)
        saved = run.mapper.saved()
        is_first = [one.stamps_ns[0] < SEAM_S * S for one in saved.submaps]
        assert saved.pieces[is_first][1:].all()  # but the loaded map's only submap
    assert run.mapper.is_placed and not saved.pieces[-1]


def test_places_of_two_pieces_need_not_agree_as_nothing_measured_how_these_lie(monkeypatch):
    far = np.array([0.0, 80.0, 2.5])  # 5 s at 1 m/s do not lead there
    run = Run(monkeypatch).drive(0, SEAM_S, FIRST).drive(SEAM_S, LAST_S, far)
    final = run.mapper.finish(path, [])
    np.testing.assert_allclose(run.moved(final, 5.0), FIRST, atol=0.02)
    np.testing.assert_allclose(run.moved(final, 35.0), far, atol=0.05)


def test_an_earlier_piece_stays_when_poses_of_the_next_are_replaced(monkeypatch):
    run = Run(monkeypatch).drive(0, SEAM_S, FIRST).drive(SEAM_S, SEAM_S + 8, SECOND)
    run.mapper.rewind(round((SEAM_S + 0.1) * S))
    run.drive(SEAM_S + 8, LAST_S, SECOND)
    np.testing.assert_allclose(run.moved(run.T_new_old, 19.0), FIRST, atol=0.02)
    np.testing.assert_allclose(run.moved(run.T_new_old, 35.0), SECOND, atol=0.02)


def test_a_place_that_was_withdrawn_does_not_come_back_where_a_piece_begins(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    scripted.answer = None
    for second in (2, 3, 4):  # in front of free space
        own.compare([placed(second, 0.0, 0.0, 0.0)])
    own.restart(5 * S)
    assert not own.fixes and own.T_map_run is None
    own.rewind(4 * S, lambda stamp_ns: se3.identity())
    assert not own.fixes and not own.is_located


@pytest.mark.parametrize("stamp_s", [1, 4])
def test_the_first_place_of_a_piece_stays_where_the_next_one_is_replaced(monkeypatch, stamp_s):
    own = located(Scripted(monkeypatch), (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    own.restart(5 * S)
    own.rewind(stamp_s * S, lambda stamp_ns: se3.identity())
    assert own.is_located and len(own.fixes) == 1


def test_a_piece_that_is_replaced_takes_its_place_along(monkeypatch):
    scripted = Scripted(monkeypatch)
    own = located(scripted, (1.0, 1.0, 0.0), run_at=(0.0, 0.0, 0.0))
    first = own.T_map_run
    own.restart(5 * S)
    scripted.answer = quality(at=(4.0, 3.0, 1.0))
    for second in (5, 6):
        own.compare([placed(second, 0.0, 0.0, 0.0)])
    assert len(own.fixes) == 2
    own.rewind(5 * S, lambda stamp_ns: se3.identity())
    np.testing.assert_allclose(own.T_map_run, first)
    assert len(own.fixes) == 1
