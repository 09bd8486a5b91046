"""One map of all modules and runs: places recognized, and loops closed."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from planar_poses import transforms

from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.lasting.map_files import load_map_files
from sceneslam.atlas.places.plan_field import PlanField
from sceneslam.atlas.places.recognition import Recognizer
from sceneslam.atlas.places.registration import register
from sceneslam.atlas.submaps.graph import consistent, on_floor, solve
from sceneslam.atlas.submaps.path_drift import PathDrift
from sceneslam.atlas.submaps.run_graph import RunGraph
from sceneslam.experiments.one_map.drive import Drive, Odometry, map_of, plan_of
from sceneslam.graphs.edge import Edge, EdgeKind
from sceneslam.testing.floor_plans import (
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
from sceneslam.types.maps import PoseGraphLayer
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.types.trajectory import Trajectory


def world(walls, seed=0):
    return World(walls, np.random.default_rng(seed), Scanner())


def around(pose, turn_rad=1.5, scans=10):
    """The poses of a turn on the spot."""
    return np.array(
        [planar.compose(pose, np.array([0, 0, yaw])) for yaw in np.linspace(0, turn_rad, scans)]
    )


def atlas(**settings):
    return Atlas(voxel_m=0.05, **settings)


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
    result = solve(transforms(nodes), motions, loops, fixed=(), loose=[0])
    return result, planar.from_transforms(result.T_map_node)


def test_loops_that_agree_are_believed_and_a_wrong_one_is_not():
    true, drifted, motions = ring()
    right = [
        edge_of(a, b, planar.between(true[a], true[b]), 0.01)
        for a, b in ((0, 12), (1, 11), (0, 11))
    ]
    wrong = edge_of(2, 9, np.array([3.0, 1.0, 1.5]), 0.01)
    drift = PathDrift(sums=np.cumsum(np.full((13, 2, 3), [[0.03], [0.0]]), axis=0))
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
    off_m = drive.loops_off_m(true)
    assert len(off_m) >= 3 and max(off_m) < 0.1


def test_a_loop_is_judged_by_what_it_measured_not_by_where_the_run_lies():
    poses, stamps_ns = transforms([[0, 0, 0], [1, 0, 1.5], [1, 2, 3]]), np.arange(3) * 10
    measured = planar.to_transform(np.array([1.0, -1.0, 3.0]))
    graph = PoseGraphLayer(
        stamps_ns=stamps_ns[[0, 2]],
        T_world_base=poses[[0, 2]],
        edges=np.array([[0, 1], [0, 1]]),
        T_from_to=np.stack([np.eye(4), measured]),
        information=np.tile(np.eye(6), (2, 1, 1)),
        is_loop=np.array([False, True]),
    )
    trajectory = Trajectory(stamps_ns=stamps_ns, T_world_base=poses)
    atlas = SimpleNamespace(
        trajectory=trajectory, fuse_maps=lambda: SimpleNamespace(pose_graph=graph)
    )
    events = [{"event": "loop", "to_ns": 0, "stamp_ns": 20}]
    off_m = Drive(atlas, events=events).loops_off_m(planar.from_transforms(poses))
    assert off_m == pytest.approx([3.0])


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
    drive = Drive(atlas, turn_deviation=0.006, **settings)
    return drive.go(world(flat()), true, odometry=odometry), true


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
    assert "gets no further loops" in fault and "division by zero" in fault
    assert len(drive.atlas.online) == len(drive.atlas.trajectory) == len(through(FLAT_TOUR[:3]))


def fail_once_it_has_loops(graph, chain, *, is_level, extend=RunGraph.extend):
    if len(graph._accepted) >= 5:
        raise ZeroDivisionError("by zero")
    return extend(graph, chain, is_level=is_level)


@pytest.mark.parametrize(
    ("name", "fail", "said"),
    [
        ("solve", lambda *_, **__: 1 / 0, "the graph was not solved at the end"),
        ("RunGraph.extend", fail_once_it_has_loops, "the graph of the run gets no further"),
    ],
)
def test_a_solution_that_fails_leaves_the_last_one_and_the_map(
    monkeypatch, tmp_path, name, fail, said
):
    monkeypatch.setattr(f"sceneslam.atlas.submaps.run_graph.{name}", fail)
    drive, true = drive_twice_round(atlas(save=str(tmp_path / "map")))
    (fault,) = drive.faults
    assert fault.startswith(said) and "by zero" in fault
    before, after = drive.drifted_m(true, map_of(true)), drive.errors_m(true, map_of(true))
    assert rms(after) < 0.6 * rms(before)
    saved = load_map_files(tmp_path / "map")
    assert sum(edge.is_loop for edge in saved.edges) == len(drive.of_kind("loop")) >= 3
    trajectory = drive.atlas.trajectory
    starts_ns = [submap.stamps_ns[0] for submap in saved.submaps]
    rows = np.searchsorted(trajectory.stamps_ns, starts_ns)
    np.testing.assert_allclose(saved.T_map_node, trajectory.T_world_base[rows], atol=1e-9)


def test_depth_images_of_another_size_are_left_out_and_named_once():
    camera = Camera(size_wh=(64, 48), fx=40.0, fy=40.0, cx=31.5, cy=23.5)
    rig = Rig(sensors=frozenset({Sensor.DEPTH}), camera=camera)
    own, events = atlas(), []
    own.open(rig, lambda event, *_, **fields: events.append((event, fields)))
    own.begin_session("a", np.eye(4))
    for index in range(60):
        shape = (24, 32) if 20 <= index < 40 else (48, 64)
        depth_m = np.full(shape, 2.0, np.float32)
        own.add(index * 10**8, planar.to_transform(np.array([0.1 * index, 0.0, 0.0])), "a")
        own.observe(Observation(stamp_ns=index * 10**8, depth_m=depth_m), None)
    assert own.finish() == []
    ((event, fields),) = events
    assert event == "warning" and "depth_m: expected" in fields["what"]
    assert len(own.fuse_maps().pose_graph.stamps_ns) == 3


def test_a_live_run_that_fails_leaves_no_thread_and_says_that_its_map_is_not_saved(
    monkeypatch, tmp_path
):
    monkeypatch.setattr("sceneslam.atlas.mapper.Mapper._tell_loops", lambda _: 1 / 0)
    before = set(threading.enumerate())
    own = atlas(save=str(tmp_path / "map"), save_every_s=0.5)
    own._lasting.open(is_live=True)
    own._lasting._executor.submit(int)  # a map was saved before
    monkeypatch.setattr(own._lasting, "open", lambda **_: None)
    drive = Drive(own, is_live=True).go(world(flat()), through(FLAT_TOUR[:3]))
    (fault,) = drive.faults
    assert "goes on without submaps and loops, its map is not saved from here on" in fault
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)  # shut down without a wait: it ends once it is scheduled
    assert set(threading.enumerate()) <= before


def test_a_run_without_loops_stays_as_it_was_to_the_bit():
    drive = Drive(atlas()).go(world(flat()), through(FLAT_TOUR[:2]))
    np.testing.assert_array_equal(
        drive.atlas.trajectory.T_world_base, drive.atlas.online.T_world_base
    )


def test_a_back_end_that_fails_leaves_the_poses(monkeypatch):
    monkeypatch.setattr("sceneslam.atlas.submaps.collector.make_submap", lambda *_: 1 / 0)
    drive = Drive(atlas()).go(world(flat()), through(FLAT_TOUR[:2]))
    assert "goes on without submaps" in drive.faults[0] and "division by zero" in drive.faults[0]
    assert len(drive.atlas.trajectory) == len(through(FLAT_TOUR[:2]))
