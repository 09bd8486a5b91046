"""One map of all modules and runs: places recognized, loops closed, maps that last."""

from concurrent.futures import Future
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from planar_poses import transforms

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting.map_files import HEAD, load_map_files, save_map_files
from sceneslam.atlas.lasting.saved_map import forget_contradicted
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.places.registration import register
from sceneslam.atlas.submaps.graph import consistent, on_floor, solve
from sceneslam.experiments.one_map.drive import Drive, Odometry, map_of, plan_of
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.maps.__main__ import main
from sceneslam.testing.floor_plans import (
    CUPBOARD,
    FLAT_TOUR,
    TWINS_FIRST,
    TWINS_SECOND,
    Scanner,
    World,
    box,
    corridor,
    flat,
    through,
    twins,
)
from sceneslam.types import planar
from sceneslam.types.errors import ConfigError, InputError


def world(walls, seed=0):
    return World(walls, np.random.default_rng(seed), Scanner())


def around(pose, turn_rad=1.5, scans=10):
    """The poses of a turn on the spot."""
    return np.array(
        [planar.compose(pose, np.array([0, 0, yaw])) for yaw in np.linspace(0, turn_rad, scans)]
    )


def atlas(**settings):
    return Atlas(voxel_m=0.05, **settings)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A map of the flat, and the poses of the drive that made it."""
    folder, true = tmp_path_factory.mktemp("flat") / "map", through(FLAT_TOUR)
    drive = Drive(atlas(save=str(folder))).go(world(flat()), true)
    assert drive.faults == []
    return folder, true


def test_a_robot_finds_itself_anywhere_in_a_room_and_nowhere_else():
    true = through(FLAT_TOUR)
    target = Recognizer(PlanField(plan_of(world(flat()), true)))
    rng, found = np.random.default_rng(1), 0
    for _ in range(12):
        pose = np.array([rng.uniform(2.2, 5.6), rng.uniform(0.5, 2.8), rng.uniform(-3, 3)])
        query = PlanField(plan_of(world(flat(), 2), around(pose)))
        match = target.recognize(query, None)
        if match is not None:
            off = planar.between(planar.between(true[0], pose), match.T_target_query)
            assert np.hypot(off[0], off[1]) < 0.05 and abs(off[2]) < np.radians(1.0)
            found += 1
    assert found >= 9


def test_of_two_rooms_that_look_alike_neither_is_recognized():
    drive = through((*TWINS_FIRST, *TWINS_SECOND))
    target = Recognizer(PlanField(plan_of(world(twins()), drive)))
    turn = around(np.array([2.5, 2.2, 0.3]), turn_rad=6.0)
    query = PlanField(plan_of(world(twins(), 1), turn))
    assert target.recognize(query, None) is None


def test_a_room_that_is_not_in_the_map_is_not_recognized():
    target = Recognizer(PlanField(plan_of(world(flat()), through(FLAT_TOUR))))
    other = box(0, 0, 7.5, 3.2) + box(2, 1, 2.5, 1.4) + box(5, 2.2, 6.3, 3.0)
    query = PlanField(plan_of(world(other), around(np.array([3.5, 1.8, 0.0]), turn_rad=6.0)))
    assert target.recognize(query, None) is None


def test_a_bare_corridor_does_not_hold_a_pose_along_it():
    seen = world(corridor())
    target = PlanField(plan_of(seen, through([(0.0, 0.0), (4.0, 0.0)])))
    query = PlanField(plan_of(seen, through([(1.0, 0.0), (3.0, 0.0)])))
    match = register(query, target, np.array([1.3, 0.1, 0.02]))
    assert match.weak_directions == 1
    assert abs(match.T_target_query[1]) < 0.02 and abs(match.T_target_query[2]) < 0.01
    assert match.covariance[0, 0] > 1.0 and match.covariance[1, 1] < 0.02**2


def ring(count=12, step_m=1.0):
    """Nodes on a circle, as measured and as they are."""
    turn = 2 * np.pi / count
    motion, true = np.array([step_m, 0.0, turn]), [np.zeros(3)]
    for _ in range(count):
        true.append(planar.compose(true[-1], motion))
    drifted = [np.zeros(3)]
    for _ in range(count):
        drifted.append(planar.compose(drifted[-1], motion + np.array([0.02, 0.0, 0.01])))
    true, drifted = np.array(true), np.array(drifted)
    motions = [
        edge_of(row, row + 1, planar.between(drifted[row], drifted[row + 1]), 0.03, EdgeKind.MOTION)
        for row in range(count)
    ]
    return true, drifted, motions


def edge_of(first, second, T_first_second, sigma, kind=EdgeKind.LOOP):
    return Edge(
        first=first,
        second=second,
        T_first_second=planar.to_transform(T_first_second),
        covariance=on_floor(np.diag([sigma, sigma, 0.5 * sigma]) ** 2),
        kind=kind,
    )


def solved(nodes, motions, loops):
    """The solution of a planar graph, and its poses in the plane."""
    result = solve(transforms(nodes), motions, loops, fixed=(), loose=0)
    return result, planar.from_transforms(result.T_map_node)


def test_loops_that_agree_are_believed_and_a_wrong_one_is_not():
    true, drifted, motions = ring()
    right = [
        edge_of(a, b, planar.between(true[a], true[b]), 0.01)
        for a, b in ((0, 12), (1, 11), (0, 11))
    ]
    wrong = edge_of(2, 9, np.array([3.0, 1.0, 1.5]), 0.01)
    drift = np.cumsum(np.full((13, 3), 0.03), axis=0)
    assert consistent([right[0], wrong, *right[1:]], transforms(drifted), drift) == [0, 2, 3]
    result, nodes = solved(drifted, motions, right)
    assert result.accepted == [0, 1, 2]
    assert np.abs(nodes[:, :2] - true[:, :2]).max() < 0.1
    assert np.abs(drifted[:, :2] - true[:, :2]).max() > 0.2


def test_a_wrong_loop_that_was_taken_is_given_up_and_the_same_input_gives_the_same_bits():
    true, drifted, motions = ring()
    loops = [
        edge_of(0, 12, planar.between(true[0], true[12]), 0.01),
        edge_of(1, 11, planar.between(true[1], true[11]), 0.01),
        edge_of(2, 9, np.array([3.0, 1.0, 1.5]), 0.01),
    ]
    (first, _), (again, _) = (solved(drifted, motions, loops) for _ in range(2))
    assert first.accepted == [0, 1]
    np.testing.assert_array_equal(first.T_map_node, again.T_map_node)


def test_loops_between_modules_take_out_what_odometry_drifts():
    true = np.concatenate([through(FLAT_TOUR), through(FLAT_TOUR)])
    odometry = Odometry(scale=0.01, turn_rad_per_m=0.003)
    drive = Drive(atlas()).go(world(flat()), true, odometry=odometry, sessions=4)
    assert len(drive.of_kind("loop")) >= 3
    before, after = drive.drifted_m(true, map_of(true)), drive.errors_m(true, map_of(true))
    assert rms(after) < rms(before) / 3


def rms(errors_m):
    return float(np.sqrt((errors_m**2).mean()))


class Watched(Atlas):
    """Knows how many poses it had at each event; `closing` modules close loops themselves."""

    def __init__(self, closing=()):
        super().__init__(voxel_m=0.05)
        self._closing_too, self.poses_at_loops, self.is_over = closing, [], False

    def open(self, rig, note, *, closing=(), **settings):
        def watch(event, stamp_ns, **fields):
            if event == "loop" and not self.is_over:
                self.poses_at_loops.append(len(self.online))
            note(event, stamp_ns, **fields)

        super().open(rig, watch, closing=self._closing_too, **settings)

    def finish(self):
        self.is_over = True
        return super().finish()


def drive_twice_round(atlas, **settings):
    """Drive through the flat twice, by odometry that drifts; return the drive and true poses."""
    true = np.concatenate([through(FLAT_TOUR), through(FLAT_TOUR)])
    odometry = Odometry(scale=0.01, turn_rad_per_m=0.003)
    return Drive(atlas, **settings).go(world(flat()), true, odometry=odometry), true


@pytest.fixture(scope="module")
def twice_round():
    return drive_twice_round(Watched())


def test_loops_are_reported_while_the_run_goes_on_and_each_of_them_once(twice_round):
    drive, true = twice_round
    loops = [(one["to_ns"], one["stamp_ns"]) for one in drive.of_kind("loop")]
    assert drive.faults == [] and len(set(loops)) == len(loops) >= 4
    early = drive.atlas.poses_at_loops
    assert len(early) >= 2 and early[0] < 0.8 * len(true) and early == sorted(early)
    ends_ns = drive.atlas.online.stamps_ns[np.array(early) - 1]
    starts_ns = [stamp_ns for _, stamp_ns in loops[: len(early)]]
    assert (ends_ns > starts_ns).all()  # a submap is complete before loops lead to it


def test_the_newest_pose_is_corrected_as_soon_as_a_loop_closed(twice_round):
    drive, true = twice_round
    closed = drive.atlas.poses_at_loops[0]
    reckoned = drive.drifted_m(true, map_of(true))
    online = drive.errors_m(true, map_of(true), is_online=True)
    np.testing.assert_allclose(online[:closed], reckoned[:closed], atol=1e-12)
    assert rms(online[closed:]) < rms(reckoned[closed:]) / 2


def test_two_equal_runs_close_the_same_loops_to_the_bit(twice_round):
    (one, _), (other, _) = twice_round, drive_twice_round(Watched())
    assert one.events == other.events
    for a, b in (
        (one.atlas.online, other.atlas.online),
        (one.atlas.trajectory, other.atlas.trajectory),
    ):
        np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
        np.testing.assert_array_equal(a.T_world_base, b.T_world_base)


def test_a_module_that_closes_loops_gets_none_within_its_sessions():
    drive, _ = drive_twice_round(Watched(closing=["module_0"]))
    assert drive.of_kind("loop") == []
    np.testing.assert_array_equal(
        drive.atlas.trajectory.T_world_base, drive.atlas.online.T_world_base
    )
    np.testing.assert_array_equal(drive.atlas.online.T_world_base, drive.atlas._path.poses)


def test_a_live_search_that_fails_leaves_the_poses_and_is_named(monkeypatch):
    monkeypatch.setattr("sceneslam.atlas.submaps.run_graph.RunGraph.extend", lambda *_, **__: 1 / 0)
    drive = Drive(atlas(), is_live=True).go(world(flat()), through(FLAT_TOUR[:3]))
    (fault,) = drive.faults
    assert "goes on without submaps" in fault and "division by zero" in fault
    assert len(drive.atlas.online) == len(drive.atlas.trajectory) == len(through(FLAT_TOUR[:3]))


def test_a_run_without_loops_stays_as_it_was_to_the_bit():
    drive = Drive(atlas()).go(world(flat()), through(FLAT_TOUR[:2]))
    np.testing.assert_array_equal(
        drive.atlas.trajectory.T_world_base, drive.atlas.online.T_world_base
    )


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


def test_a_back_end_that_fails_leaves_the_poses(monkeypatch):
    monkeypatch.setattr("sceneslam.atlas.submaps.collector.make_submap", lambda *_: 1 / 0)
    drive = Drive(atlas()).go(world(flat()), through(FLAT_TOUR[:2]))
    assert "goes on without submaps" in drive.faults[0] and "division by zero" in drive.faults[0]
    assert len(drive.atlas.trajectory) == len(through(FLAT_TOUR[:2]))


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
        ({"mode": "localize"}, "mode: got 'localize', allowed: extend where no map is loaded"),
        ({"load": "missing"}, "load: got 'missing', allowed: the folder of a saved map"),
        ({"save_every_s": 0.0}, "save_every_s: got 0.0, allowed: seconds above 0"),
    ],
)
def test_a_setting_that_does_not_fit_is_named(settings, said):
    with pytest.raises(ConfigError, match=said.replace("|", r"\|")):
        atlas(**settings)


def test_a_folder_that_holds_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ConfigError, match="empty or holds a map"):
        atlas(save=str(tmp_path))


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
                (f / HEAD).read_text().replace("version: 2", "version: 3")
            ),
            "version 3, a newer SceneSLAM wrote it",
        ),
        (
            lambda f, a: (f / HEAD).write_text("format: sceneslam-map\nversion: 2\n"),
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
