"""A whole run in memory: what its folder holds, and what is saved when it goes wrong."""

import json
import os
import resource
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from configured import config
from fakes import FakeSource, LateStamps

from sceneslam.app import run
from sceneslam.atlas.atlas import Atlas
from sceneslam.atlas.uncertainty import read_covariances
from sceneslam.evaluation.metrics import evaluate
from sceneslam.types.errors import ConfigError
from sceneslam.types.trajectory import Trajectory


def test_run_through_a_scene_change_is_measured_and_written(tmp_path):
    finished = run(config(), tmp_path)
    assert finished.faults == ()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["coverage"] == 1.0 and metrics["ate_rmse_m"] < 1e-9
    (switch,) = metrics["switches"]
    assert (switch["from"], switch["to"]) == ("bright", "dark")
    assert switch["confirm_delay_s"] == pytest.approx(2.0)
    assert metrics["false_switches"] == 0
    for name in ("events.jsonl", "config.yaml", "report.html", "map/points.ply"):
        assert (tmp_path / name).stat().st_size > 0
    for name in ("trajectory_0_bright.tum", "trajectory_1_dark.tum"):
        local = Trajectory.read_tum(tmp_path / name)
        np.testing.assert_allclose(local.T_world_base[0], np.eye(4), atol=1e-9)


def test_two_runs_give_identical_trajectories_and_events(tmp_path):
    for name in ("one", "two"):
        run(config(), tmp_path / name)
    one, two = ((tmp_path / name / "trajectory.tum").read_bytes() for name in ("one", "two"))
    assert one == two

    def decisions(name):
        lines = (tmp_path / name / "events.jsonl").read_text().splitlines()
        return [line for line in lines if json.loads(line)["event"] != "cost"]

    assert decisions("one") == decisions("two")


@pytest.mark.parametrize("isolation", ["inline", "process"])
def test_the_atlas_knows_which_modules_close_loops_themselves(tmp_path, monkeypatch, isolation):
    told, opened = [], Atlas.open

    def watched(atlas, rig, note, *, closing, **settings):
        told.append(list(closing))
        opened(atlas, rig, note, closing=closing, **settings)

    monkeypatch.setattr(Atlas, "open", watched)
    dark = {"_target_": "fakes.ClosingModule"}
    assert run(config(slam__dark=dark, run__isolation=isolation), tmp_path).faults == ()
    assert told == [["dark"]]


def test_trajectories_have_the_stamps_of_the_recording(tmp_path):
    run(config(), tmp_path / "exact")
    run(config(source___target_="fakes.LateStamps"), tmp_path / "late")
    for name in ("trajectory.tum", "trajectory_online.tum"):
        exact, late = (Trajectory.read_tum(tmp_path / one / name) for one in ("exact", "late"))
        logged_ns = LateStamps(100, 40).logged_ns(exact.stamps_ns)
        order = np.argsort(logged_ns)
        np.testing.assert_array_equal(late.stamps_ns, logged_ns[order])
        np.testing.assert_array_equal(late.T_world_base, exact.T_world_base[order])
    path = tmp_path / "late" / "trajectory_covariance.txt"
    np.testing.assert_array_equal(read_covariances(path)[0], late.stamps_ns)


def test_the_pose_graph_has_the_stamps_of_the_recording_and_its_vertices_stay_in_order(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(LateStamps, "logged_ns", lambda _, stamps_ns: 100 * 10**9 - stamps_ns)
    run(config(), tmp_path / "exact")
    run(config(source___target_="fakes.LateStamps"), tmp_path / "late")
    exact, late = (np.loadtxt(tmp_path / one / "map/pose_graph.tum") for one in ("exact", "late"))
    np.testing.assert_allclose(late[:, 0], 100.0 - exact[:, 0])
    np.testing.assert_array_equal(late[:, 1:], exact[:, 1:])


def test_input_that_breaks_off_leaves_what_was_computed(tmp_path):
    finished = run(config(source__breaks_at=70), tmp_path)
    assert finished.faults == ("the recording breaks off: fake.bag",)
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 70
    assert "breaks off" in (tmp_path / "report.html").read_text()


def test_ctrl_c_leaves_what_was_computed(tmp_path):
    module = {"_target_": "fakes.InterruptedModule", "at": 30}
    finished = run(config(slam__bright=module), tmp_path)
    assert "stopped" in finished.faults[0]
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 30
    assert (tmp_path / "metrics.json").exists()


def test_run_without_a_module_left_says_so_and_is_saved(tmp_path):
    broken = {"_target_": "fakes.ExactModule", "raises": [10]}
    finished = run(config(slam__bright=broken, slam__dark=broken), tmp_path)
    assert "no module is left for scene Bright" in finished.faults[0]
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) >= 10


def test_run_with_a_scene_whose_module_failed_says_so_and_goes_on(tmp_path):
    broken = {"_target_": "fakes.ExactModule", "raises": [10]}
    scenes = {"Bright": ["bright"], "Dark": ["dark"]}
    finished = run(config(slam__bright=broken, scenes=scenes), tmp_path)
    (fault,) = finished.faults
    assert fault.startswith("no module is left for scene Bright: slam.bright failed")
    assert "dark" in (tmp_path / "events.jsonl").read_text()


def test_damage_that_the_source_reports_is_passed_on(tmp_path):
    finished = run(config(source__fault="3 % of the file could not be read"), tmp_path)
    assert finished.faults == ("3 % of the file could not be read",)


def test_run_stops_after_so_many_observations(tmp_path):
    finished = run(config(run__max_observations=12), tmp_path)
    assert len(finished.trajectory) == 12


def test_live_run_gives_every_taken_observation_a_pose(tmp_path):
    finished = run(config(run__mode="live", source__steps=10), tmp_path)
    assert finished.metrics["coverage"] == 1.0
    assert finished.metrics["realtime_factor"] <= 1.1


def test_reference_is_compared(tmp_path):
    reference = run(config(source__dark_from=1000), tmp_path / "reference").trajectory
    finished = run(config(), tmp_path / "run", reference=reference)
    assert finished.metrics["reference"]["max_difference_m"] < 1e-9


def test_a_run_that_never_sees_a_first_scene_says_so(tmp_path):
    finished = run(config(policy__first_confirm_window_s=100.0), tmp_path)
    assert len(finished.trajectory) == 0
    assert "no pose" in finished.faults[0]


def test_ground_truth_that_cannot_be_read_costs_no_result(tmp_path):
    finished = run(config(source___target_="fakes.SourceWithoutTruth"), tmp_path)
    assert finished.faults == ("no ground truth: groundtruth.txt: line 3",)
    assert finished.metrics["ate_rmse_m"] is None and len(finished.trajectory) == 100


def test_source_that_breaks_at_its_ground_truth_costs_no_result(tmp_path):
    finished = run(config(source___target_="fakes.BuggyTruth"), tmp_path)
    assert finished.faults == ("no ground truth: ValueError: 7 numbers",)


def test_source_that_calls_sys_exit_outside_its_observations_costs_the_truth_alone(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(FakeSource, "ground_truth", lambda self: sys.exit(3))
    monkeypatch.setattr(FakeSource, "survey", lambda self: sys.exit(3), raising=False)
    finished = run(config(run__report=False), tmp_path)
    assert finished.faults == ("no ground truth: SystemExit: 3",)
    assert len(finished.trajectory) == 100 and (tmp_path / "metrics.json").exists()
    assert (tmp_path / "metrics.json").exists() and len(finished.trajectory) == 100


def test_ground_truth_that_cannot_be_compared_costs_no_result(tmp_path):
    finished = run(config(source___target_="fakes.TruthOfNaN"), tmp_path)
    assert finished.faults[0].startswith("no comparison with the ground truth: ")
    assert finished.metrics["ate_rmse_m"] is None and len(finished.trajectory) == 100
    assert (tmp_path / "metrics.json").exists() and (tmp_path / "map").is_dir()


@pytest.mark.parametrize(
    "changes",
    [
        {"source___target_": "fakes.SourceWithoutTruth"},
        {"sinks": {"tape": {"_target_": "hostile_parts.Fails", "method": "close"}}},
    ],
)
def test_what_fails_beside_the_results_leaves_no_journal(tmp_path, changes):
    allowed = ["fakes", "hostile_parts"]
    finished = run(config(**changes, allow_targets=allowed, run__report=False), tmp_path)
    assert finished.faults and not (tmp_path / "journal.bin").exists()


def test_ctrl_c_before_the_first_observation_ends_at_once(tmp_path):
    finished = run(config(source___target_="fakes.InterruptedSource"), tmp_path)
    assert finished.is_interrupted and "stopped after 0" in finished.faults[0]


def test_unexpected_error_leaves_what_was_computed(tmp_path):
    finished = run(config(source___target_="fakes.BuggySource"), tmp_path)
    assert "unexpected ZeroDivisionError" in finished.faults[0]
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 50


def test_sink_that_cannot_write_is_left_out_and_named(tmp_path):
    finished = run(config(sinks={"full": {"_target_": "fakes.FullDisk"}}), tmp_path)
    assert finished.faults == ("sinks.full stopped writing: OSError: no space left on device",)
    assert len(finished.trajectory) == 100


def test_sink_whose_operator_cannot_be_heard_is_left_out_and_named(tmp_path):
    finished = run(config(sinks={"deaf": {"_target_": "fakes.DeafSink"}}), tmp_path)
    assert finished.faults == ("sinks.deaf stopped writing: OSError: no such microphone",)
    assert len(finished.trajectory) == 100


def test_events_of_a_pause_and_of_the_end_reach_the_sinks(tmp_path):
    assert not run(config(sinks={"one": {"_target_": "fakes.PausingSink"}}), tmp_path).faults
    heard = json.loads((tmp_path / "heard.json").read_text())
    assert [one.pop("asked") for one in heard if one["event"] == "command"] == [3, 6]
    logged = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [one["event"] for one in heard] == [one["event"] for one in logged]


def test_folder_holds_the_newest_run_alone(tmp_path):
    run(config(), tmp_path)
    run(config(source__dark_from=1000), tmp_path)
    assert not (tmp_path / "trajectory_1_dark.tum").exists()


def test_module_that_no_scene_names_is_said_not_to_run(tmp_path, caplog):
    run(config(scenes__Dark=["bright"], scenes__Bright=["bright"]), tmp_path)
    assert "slam.dark: no scene names it" in caplog.text


@contextmanager
def largest_file(size):
    """Let no file grow beyond `size` bytes, as if the disk were full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [6000, 20000])
def test_a_full_disk_is_told_in_sentences_and_keeps_what_fits(tmp_path, size):
    with largest_file(size):
        finished = run(config(), tmp_path)
    assert len(finished.trajectory) == 100 and finished.metrics["coverage"] == 1.0
    assert finished.faults and all("File too large" in fault for fault in finished.faults)
    is_saved = size == 20000
    is_cut = any("events.jsonl is not complete" in fault for fault in finished.faults)
    assert is_cut is not is_saved
    assert (tmp_path / "trajectory.tum").exists() is is_saved
    if is_saved:
        assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 100
    assert not list(tmp_path.glob("**/*.part"))


def test_a_disk_without_room_for_the_configuration_is_refused_and_left_alone(tmp_path):
    with largest_file(0), pytest.raises(ConfigError, match="File too large"):
        run(config(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_maps_that_cannot_be_fused_cost_the_map_alone(tmp_path, monkeypatch):
    def fail(atlas):
        raise MemoryError("too large")

    monkeypatch.setattr("sceneslam.atlas.atlas.Atlas.fuse_maps", fail)
    finished = run(config(), tmp_path)
    assert finished.faults == ("the maps could not be fused: MemoryError: too large",)
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 100


def test_covariances_that_fail_cost_their_file_alone(tmp_path, monkeypatch):
    def fail(atlas, wheels):
        raise MemoryError("too large")

    monkeypatch.setattr("sceneslam.atlas.atlas.Atlas.covariances", fail)
    finished = run(config(), tmp_path)
    assert finished.faults == ("the trajectory has no covariances: MemoryError: too large",)
    assert not (tmp_path / "trajectory_covariance.txt").exists()


def test_metrics_that_fail_cost_neither_map_nor_report(tmp_path, monkeypatch):
    def fail(*_):
        raise MemoryError("too large")

    real = evaluate

    def breaks(result, *given, **more):
        return fail() if len(result.trajectory) else real(result, *given, **more)

    monkeypatch.setattr("sceneslam.results.evaluate", breaks)
    finished = run(config(), tmp_path)
    assert finished.faults[1] == "the metrics could not all be saved: MemoryError: too large"
    assert finished.metrics["observations"] == 100 and not (tmp_path / "metrics.json").exists()
    assert (tmp_path / "map" / "points.ply").exists() and (tmp_path / "report.html").exists()


@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="only on Linux")
def test_peak_memory_is_that_of_the_run_alone(tmp_path):
    block = np.ones(60_000_000)  # 458 MB
    first_mb = run(config(run__report=False), tmp_path / "one").metrics["peak_rss_mb"]
    del block
    second_mb = run(config(run__report=False), tmp_path / "two").metrics["peak_rss_mb"]
    assert 400 < first_mb - second_mb < 600


def test_ground_truth_that_cannot_be_written_costs_no_metrics(tmp_path, monkeypatch):
    write = Trajectory.write_tum

    def fail(trajectory, path):
        if path.name == "groundtruth.tum":
            raise OSError("the disk is full")
        write(trajectory, path)

    monkeypatch.setattr(Trajectory, "write_tum", fail)
    finished = run(config(), tmp_path)
    assert finished.faults == (
        "the ground truth could not all be saved: OSError: the disk is full",
    )
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["errors"] == finished.metrics["errors"] == list(finished.faults)


def test_trajectory_of_a_session_that_cannot_be_written_costs_no_other(tmp_path, monkeypatch):
    write = Trajectory.write_tum

    def fail(trajectory, path):
        if path.name in ("trajectory_online.tum", "trajectory_0_bright.tum"):
            raise OSError("the disk is full")
        write(trajectory, path)

    monkeypatch.setattr(Trajectory, "write_tum", fail)
    finished = run(config(run__report=False), tmp_path)
    assert finished.faults == (
        "the other trajectories could not all be saved: OSError: the disk is full",
    )
    written = {path.name for path in tmp_path.glob("traj*.tum")}
    assert written == {"trajectory.tum", "trajectory_1_dark.tum"}


def test_a_module_that_leaves_the_folder_does_not_take_the_results_along(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    leaves = {"_target_": "hostile.Wrecks", "how": "move"}
    monkeypatch.setattr("os.environ", dict(os.environ))
    allowed = ["fakes", "hostile"]
    mask = os.umask(0)
    try:
        run(config(slam__bright=leaves, allow_targets=allowed), Path("here"))
    finally:
        os.umask(mask)
    assert len(Trajectory.read_tum(tmp_path / "here" / "trajectory.tum")) == 100


def test_a_figure_that_no_memory_is_left_for_costs_no_other_result(tmp_path, monkeypatch):
    def draw(*_):
        raise MemoryError

    monkeypatch.setattr("sceneslam.evaluation.figures.run_figures.draw_map", draw)
    finished = run(config(), tmp_path)
    assert finished.faults == ("the figure map could not be drawn: MemoryError",)
    assert not (tmp_path / "figures" / "map.png").exists()
    assert (tmp_path / "figures" / "error.png").exists()
    assert finished.faults[0] in (tmp_path / "report.html").read_text()


def test_a_page_that_no_memory_is_left_for_costs_the_page_alone(tmp_path, monkeypatch):
    def fill(*_):
        raise MemoryError

    monkeypatch.setattr("sceneslam.evaluation.report.run_page.fill_page", fill)
    finished = run(config(), tmp_path)
    assert finished.faults == ("the report could not all be saved: MemoryError",)
    assert (tmp_path / "metrics.json").exists() and (tmp_path / "map" / "points.ply").exists()
    assert (tmp_path / "journal.bin").exists()  # `recover` can write it when there is memory


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_a_closed_terminal_ends_a_run_as_sigterm_does(tmp_path, number):
    sink = {"_target_": "fakes.Killer", "at": 30, "number": int(number)}
    finished = run(config(sinks={"killer": sink}, run__report=False), tmp_path)
    assert finished.is_interrupted
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 31


def test_nohup_keeps_a_run_going(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        sink = {"_target_": "fakes.Killer", "at": 30, "number": int(signal.SIGHUP)}
        finished = run(config(sinks={"killer": sink}, run__report=False), tmp_path)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not finished.is_interrupted and len(finished.trajectory) == 100


def test_the_trajectory_is_written_before_sinks_and_truth_are_waited_for(tmp_path):
    source = "fakes.SourceWhoseTruthNeedsTheTrajectory"
    finished = run(
        config(source___target_=source, source__folder=str(tmp_path), run__report=False), tmp_path
    )
    assert finished.faults == ()
