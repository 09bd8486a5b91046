"""Maps that last: saved, loaded, kept up to date, damaged and merged."""

import re
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_one_map import atlas, world

from sceneslam.atlas.lasting.map_files import HEAD, VERSION, load_map_files, save_map_files
from sceneslam.atlas.lasting.saved_map import forget_contradicted
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.experiments.one_map.drive import RIG, Drive, map_of
from sceneslam.maps.__main__ import main
from sceneslam.testing.floor_plans import CUPBOARD, FLAT_TOUR, box, flat, through
from sceneslam.types import planar
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.observation import Observation


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A map of the flat, and the poses of the drive that made it."""
    folder, true = tmp_path_factory.mktemp("flat") / "map", through(FLAT_TOUR)
    drive = Drive(atlas(save=str(folder))).go(world(flat()), true)
    assert drive.faults == []
    return folder, true


def test_a_map_that_is_saved_loaded_and_saved_has_the_same_bytes(saved, tmp_path):
    folder, _ = saved
    save_map_files(load_map_files(folder), tmp_path / "again")
    for path in folder.iterdir():
        assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes()


def test_a_run_finds_itself_in_a_loaded_map_and_its_poses_lie_in_it(saved, tmp_path):
    folder, first = saved
    true = through([(7.3, 0.9), (9.2, 1.0), (9.3, 2.0), (5.2, 2.0), (3.2, 0.9), (5.3, 0.9)])
    drive = Drive(atlas(load=str(folder), save=str(tmp_path / "map"))).go(world(flat(), 5), true)
    found = drive.of_kind("relocalized")
    assert len(found) == 1 and found[0]["after_s"] <= 3.0 and drive.faults == []
    assert drive.errors_m(true, map_of(first)).max() < 0.05
    both = load_map_files(tmp_path / "map")
    assert both.runs == 2 and set(both.pieces.tolist()) == {0}


def test_a_run_whose_poses_were_replaced_is_where_the_new_ones_lead(saved):
    """A module measures 12 s of motion a fifth too long, until a hand-over replaces its poses."""
    folder, first = saved
    own, room, events = atlas(load=str(folder)), world(flat(), 5), []
    step_ns = 200_000_000
    own.open(RIG, lambda event, *_, **__: events.append(event))
    true = through([(7.3, 0.9), (9.2, 1.0), (9.3, 2.0), (5.2, 2.0), (3.2, 0.9), (5.3, 0.9)])
    right = [planar.between(true[0], pose) for pose in true]
    T_run_base, off_m = right[0], []
    for row, pose in enumerate(true):
        step = planar.between(right[max(row - 1, 0)], right[row])
        T_run_base = planar.compose(T_run_base, step * ([1.2, 1.2, 1.0] if row > 15 else 1.0))
        if row == 75:
            own.rewind(16 * step_ns)
        since = 16 if row == 75 else row
        for given in range(since, row + 1):
            T = T_run_base if row < 75 else right[given]
            own.add(given * step_ns, planar.to_transform(T), "a", np.eye(6) * 1e-4)
        seen = Observation(stamp_ns=row * step_ns, scan=room.scan(pose, row * step_ns))
        own.observe(seen, None)
        at = planar.compose(map_of(first), pose)
        off_m.append(np.linalg.norm(own.pose_at(row * step_ns)[:2, 3] - at[:2]))
    assert own.finish() == [] and "relocalization_withdrawn" not in events
    assert max(off_m[60:75]) > 0.2 and max(off_m[75:]) < 0.05
    expected = [planar.compose(map_of(first), pose)[:2] for pose in true]
    assert np.abs(own.trajectory.positions_m[:, :2] - expected).max() < 0.02


class Later(Future):
    """The result of a call that is made when it is asked for the second time."""

    def __init__(self, function, *args):
        super().__init__()
        self._call, self._asked = partial(function, *args), 0

    def done(self):
        self._asked += 1
        if self._asked == 2:
            self.set_result(self._call())
        return super().done()


def test_a_live_run_looks_for_itself_and_saves_beside_its_poses(saved, tmp_path, monkeypatch):
    beside = SimpleNamespace(submit=Later, shutdown=lambda: None)
    monkeypatch.setattr("sceneslam.executors.ThreadPoolExecutor", lambda *_, **__: beside)
    folder, first = saved
    true = through([(7.3, 0.9), (9.2, 1.0), (9.3, 2.0), (5.2, 2.0), (3.2, 0.9), (5.3, 0.9)])
    live = atlas(load=str(folder), save=str(tmp_path / "map"), save_every_s=2.0)
    drive = Drive(live, is_live=True).go(world(flat(), 5), true)
    assert drive.faults == [] and len(drive.of_kind("relocalized")) == 1
    assert drive.errors_m(true, map_of(first)).max() < 0.05
    assert load_map_files(tmp_path / "map").runs == 2


def test_a_run_that_was_found_moves_the_map_that_it_is_saved_in(saved, tmp_path):
    folder, _ = saved
    true = through([(0.6, 2.6), (3.0, 2.4), (2.6, 0.7), (0.5, 0.5), (0.4, 2.4), (3.0, 2.2)])
    drive = Drive(atlas(load=str(folder), save=str(tmp_path / "map"))).go(world(flat(), 3), true)
    assert drive.faults == []
    before = load_map_files(folder).T_map_node
    after = load_map_files(tmp_path / "map").T_map_node[: len(before)]
    np.testing.assert_array_equal(after[0], before[0])
    moved_m = np.linalg.norm((after - before)[1:, :3, 3], axis=1)
    assert moved_m.min() > 1e-6 and moved_m.max() < 0.03


def test_the_grid_of_a_run_that_was_found_is_that_of_the_whole_map(saved):
    folder, first = saved
    true = through([(0.6, 2.6), (3.0, 2.4), (3.2, 0.8)])  # of one room
    alone = Drive(atlas()).go(world(flat(), 7), true).atlas.fuse_maps()
    drive = Drive(atlas(load=str(folder))).go(world(flat(), 7), true)
    fused = drive.atlas.fuse_maps()
    grid, graph = fused.grid, fused.pose_graph
    assert alone.grid is None  # dead reckoning draws none
    assert (np.diff(graph.stamps_ns) > 0).all()  # of this run alone
    assert len(graph.stamps_ns) == len(alone.pose_graph.stamps_ns)
    at = planar.compose(map_of(first), np.array([9.5, 3.5, 0.0]))[:2]  # in the other
    column, row = ((at - grid.origin_xy_m) / grid.resolution_m).astype(int)
    assert grid.log_odds[row, column] < 0


@pytest.mark.parametrize("mode", ["extend", "update"])
def test_a_loaded_map_that_is_too_large_for_a_grid_costs_no_other_layer(saved, monkeypatch, mode):
    drive = Drive(atlas(load=str(saved[0]), mode=mode)).go(world(flat(), 7), through(FLAT_TOUR[:3]))
    assert drive.of_kind("relocalized")
    monkeypatch.setattr("sceneslam.atlas.places.floor_plan._CELLS_MAX", 10)
    fused = drive.atlas.fuse_maps()
    assert fused.grid is None and len(fused.pose_graph.stamps_ns)


def test_a_run_that_is_nowhere_in_the_map_says_so_and_keeps_its_own_piece(saved, tmp_path):
    folder, _ = saved
    other = world(box(0, 0, 7.5, 3.2) + box(2, 1, 2.5, 1.4) + box(5, 2.2, 6.3, 3.0))
    true = through([(1.0, 0.5), (6.5, 0.6), (6.8, 1.5), (3.2, 2.5), (1.0, 2.5)])
    drive = Drive(atlas(load=str(folder), save=str(tmp_path / "map"))).go(other, true)
    assert drive.of_kind("not_relocalized") and not drive.of_kind("relocalized")
    assert "was not found in the map" in drive.faults[0]
    assert drive.errors_m(true, map_of(true)).max() < 0.05
    assert set(load_map_files(tmp_path / "map").pieces.tolist()) == {0, 1}


def test_furniture_that_was_moved_is_forgotten_by_an_update(saved, tmp_path):
    folder, first = saved
    moved = [wall for wall in flat() if wall not in CUPBOARD] + box(4.6, 0.1, 5.4, 0.5)
    true = through([(0.6, 2.6), (3.0, 2.4), (2.6, 0.7), (0.5, 0.5), (0.4, 2.4), (3.0, 2.2)])
    settings = {"load": str(folder), "save": str(tmp_path / "map"), "mode": "update"}
    drive = Drive(atlas(**settings)).go(world(moved, 3), true)
    assert drive.faults == []
    plan = load_map_files(tmp_path / "map").plan()
    corners = [planar.compose(map_of(first), np.array([x, y, 0.0]))[:2] for x, y in
               ((1.0, 1.5), (1.4, 1.0), (1.8, 1.5), (1.4, 2.0))]  # fmt: skip
    for corner in corners:
        away_m = np.linalg.norm(plan.points - corner, axis=1).min()
        column, row = plan.cells(corner[None])[0]
        assert away_m > 0.15 and plan.free[row, column]


def test_a_run_that_localizes_leaves_the_map_as_it_is(saved):
    folder, first = saved
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    true = through([(3.0, 2.4), (3.2, 0.8), (5.4, 0.9), (5.4, 2.0)])
    drive = Drive(atlas(load=str(folder), mode="localize")).go(world(flat(), 7), true)
    assert drive.errors_m(true, map_of(first)).max() < 0.05
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"mode": "guess"}, "mode: got 'guess', allowed: localize | extend | update"),
        (
            {"mode": "localize"},
            "mode: got 'localize', allowed: extend where no map is loaded (atlas.load=FOLDER)",
        ),
        ({"load": "missing"}, "load: got 'missing', allowed: the folder of a saved map"),
        ({"save_every_s": 0.0}, "save_every_s: got 0.0, allowed: seconds above 0"),
    ],
)
def test_a_setting_that_does_not_fit_is_named(settings, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        atlas(**settings)


def test_a_folder_that_holds_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ConfigError, match="empty or holds a map"):
        atlas(save=str(tmp_path))


@pytest.mark.parametrize("folder", ["/proc/map", "{tmp_path}/maps/" + 300 * "m"])
def test_a_folder_that_cannot_be_made_is_refused_before_the_run(tmp_path, folder):
    with pytest.raises(ConfigError, match="it cannot be made in"):
        atlas(save=folder.format(tmp_path=tmp_path))
    atlas(save=str(tmp_path / "maps" / "map"))
    assert not list(tmp_path.iterdir())


def damaged(folder, tmp_path, harm):
    copy = tmp_path / "map"
    copy.mkdir()
    for path in folder.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    harm(copy, next(copy.glob("arrays-*.npz")))
    return copy


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda f, a: a.write_bytes(a.read_bytes()[:-100]), "damaged, its checksum is another"),
        (lambda f, a: a.unlink(), "not complete, arrays-.* is missing"),
        (lambda f, a: (f / HEAD).unlink(), "not a map, it has no map.yaml"),
        (lambda f, a: (f / HEAD).write_text("image: grid.pgm\n"), "not a map of SceneSLAM"),
        (lambda f, a: (f / HEAD).write_text("a: [\n"), "map.yaml cannot be read"),
        (
            lambda f, a: (f / HEAD).write_text(
                (f / HEAD).read_text().replace(f"version: {VERSION}", f"version: {VERSION + 1}")
            ),
            f"version {VERSION + 1}, a newer SceneSLAM wrote it",
        ),
        (
            lambda f, a: (f / HEAD).write_text(f"format: sceneslam-map\nversion: {VERSION}\n"),
            "arrays: missing, the map's map.yaml is not complete",
        ),
    ],
)
def test_every_damage_has_its_sentence(saved, tmp_path, harm, said):
    with pytest.raises(InputError, match=said):
        load_map_files(damaged(saved[0], tmp_path, harm))


@pytest.mark.parametrize("writes", [0, 1, 2, 3])
def test_whoever_is_killed_while_saving_leaves_a_whole_map(saved, tmp_path, monkeypatch, writes):
    folder = damaged(saved[0], tmp_path, lambda f, a: None)
    old = load_map_files(folder)
    done = []

    def dies(function):
        def maybe(*args, **more):
            if len(done) == writes:
                raise KeyboardInterrupt
            done.append(function)
            return function(*args, **more)

        return maybe

    monkeypatch.setattr(Path, "replace", dies(Path.replace))
    monkeypatch.setattr(Path, "unlink", dies(Path.unlink))
    smaller = old.of(range(len(old.submaps) - 1))
    with pytest.raises(KeyboardInterrupt):
        save_map_files(smaller, folder)
        raise KeyboardInterrupt  # it was not killed
    monkeypatch.undo()
    assert len(load_map_files(folder).submaps) in (len(old.submaps), len(smaller.submaps))


def test_nothing_is_forgotten_that_another_run_did_not_contradict(saved):
    old = load_map_files(saved[0])
    kept = forget_contradicted(old, run=5)
    assert kept is old


def test_two_maps_of_one_place_are_merged(saved, tmp_path, capsys):
    folder, first = saved
    true = through([(7.3, 0.9), (9.2, 1.0), (9.3, 2.0), (5.2, 2.0), (3.2, 0.9), (5.3, 0.9)])
    Drive(atlas(save=str(tmp_path / "second"))).go(world(flat(), 5), true)
    both = tmp_path / "both"
    assert main(["merge", str(folder), str(tmp_path / "second"), "--out", str(both)]) == 0
    assert "runs: 2" in capsys.readouterr().out
    merged, count = load_map_files(both), len(load_map_files(folder).submaps)
    off = planar.between(planar.compose(map_of(first), true[0]), merged.plane[count])
    assert np.hypot(off[0], off[1]) < 0.03 and abs(off[2]) < 0.01
    assert main(["check", str(both)]) == 0


def test_maps_of_two_places_stay_apart(saved, tmp_path, capsys):
    other = world(box(0, 0, 7.5, 3.2) + box(2, 1, 2.5, 1.4) + box(5, 2.2, 6.3, 3.0))
    true = through([(1.0, 0.5), (6.5, 0.6), (6.8, 1.5), (3.2, 2.5), (1.0, 2.5)])
    Drive(atlas(save=str(tmp_path / "other"))).go(other, true)
    both = str(tmp_path / "both")
    assert main(["merge", str(saved[0]), str(tmp_path / "other"), "--out", both]) == 1
    assert "stay apart: 1" in capsys.readouterr().err
    assert main(["check", both]) == 0


def test_a_map_is_thinned_where_it_was_seen_again(saved, tmp_path, capsys):
    true = np.concatenate([through(FLAT_TOUR), through(FLAT_TOUR)])
    Drive(atlas(save=str(tmp_path / "twice"))).go(world(flat()), true)
    thin = tmp_path / "thin"
    assert main(["prune", str(tmp_path / "twice"), "--out", str(thin)]) == 0
    before, after = load_map_files(tmp_path / "twice"), load_map_files(thin)
    assert len(after.submaps) <= 0.7 * len(before.submaps)
    walls = before.plan().points.astype(np.float64)
    assert (PlanField(after.plan()).nearest(walls).distance_m < 0.1).mean() > 0.97
    assert main(["check", str(thin)]) == 0


def test_a_map_is_exported_and_told_about(saved, tmp_path, capsys):
    assert main(["info", str(saved[0])]) == 0
    assert "piece 0:" in capsys.readouterr().out
    assert main(["export", str(saved[0]), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "grid.pgm").read_bytes().startswith(b"P5")
    assert "EDGE_SE3:QUAT 0 1" in (tmp_path / "pose_graph.g2o").read_text()
    assert main(["info", str(tmp_path)]) == 2
    assert "not a map, it has no map.yaml" in capsys.readouterr().err
