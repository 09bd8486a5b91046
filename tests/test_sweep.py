"""Sweeps: every launcher gives the same table, dead jobs take nobody along, the rest is resumed."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import closing, nullcontext
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace

import pytest
from configured import config
from hydra import compose, initialize_config_module
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from sceneslam.app import run
from sceneslam.collect.rows import read_rows
from sceneslam.collect.status import State, Status
from sceneslam.config.check import check_keys, check_maps_apart
from sceneslam.interrupts import termination_noted
from sceneslam.storage.folder import RunFolder
from sceneslam.sweep.__main__ import main
from sceneslam.sweep.backends import Basic, Joblib, Ray, Submitit
from sceneslam.sweep.snapshot import keep_code
from sceneslam.sweep.supervise import JobOrder, run_job
from sceneslam.sweep.sweep import run_sweep
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.files import MARK

ROOT = Path(__file__).parents[1]
JOBS = ("+scenario=single", "source=mcap", "source.path=room.mcap", "slam@slam.only=odometry")
SLOW = (*JOBS, "run.mode=live")  # paced: 30 observations take a second


def start(folder, *overrides):
    words = [sys.executable, "-m", "sceneslam", "-m", *overrides, "~sinks@sinks.rerun"]
    return subprocess.Popen(
        [*words, "run.report=false"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def sweep(folder, *overrides):
    process = start(folder, *overrides)
    out, errors = process.communicate(timeout=300)
    return process.returncode, out, errors


def table(folder):
    with (folder / "table.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def wait_for(folder, state):
    """Return the status of a job once it has come to a state."""
    deadline_s = monotonic() + 60
    while monotonic() < deadline_s:
        status = Status.read(folder)
        if status is not None and status.state is state:
            return status
        sleep(0.02)
    raise AssertionError(f"{folder.name} never came to {state}")


MIXED = (*JOBS, "policy.confirm_window_s=1,-1")  # -1 is a mistake


@pytest.fixture(scope="module")
def basic(tmp_path_factory, recording):
    folder = tmp_path_factory.mktemp("basic")
    (folder / "room.mcap").symlink_to(recording)
    return sweep(folder, *MIXED, "hydra.sweep.dir=out"), folder / "out"


def test_failed_jobs_are_rows_like_the_others(basic):
    (code, out, errors), folder = basic
    assert code == 1 and "2 jobs: 1 done, 1 failed" in out, errors
    rows = table(folder)
    assert [row["status"] for row in rows] == ["done", "failed"]
    assert [row["policy.confirm_window_s"] for row in rows] == ["1", "-1"]
    assert "policy.confirm_window_s: got -1" in rows[1]["error"]
    assert rows[0]["path_length_m"] and not rows[1]["path_length_m"]
    assert "| 0 | 1 | done |" in out
    assert "Traceback" not in errors


def test_progress_is_one_line_over_all_jobs(basic):
    (_, _, errors), _ = basic
    assert "2/2" in errors and "1 failed" in errors
    assert "30/30" not in errors  # a job's own bar is in its log


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "submitit_slurm", "ray"])
def test_every_launcher_gives_the_same_table_to_the_bit(folder, basic, launcher, monkeypatch):
    stand_in = Path(__file__).with_name("slurm_stand_in")
    monkeypatch.setenv("PATH", f"{stand_in}{os.pathsep}{os.environ['PATH']}")
    words = [f"hydra/launcher={launcher}", "hydra.sweep.dir=out"]
    code, _, errors = sweep(folder, *MIXED, *words)
    assert code == 1, errors
    assert (folder / "out" / "table.csv").read_bytes() == (basic[1] / "table.csv").read_bytes()


def test_killed_job_takes_nobody_along_and_is_resumed(folder, capsys):
    jobs = (*JOBS, "policy.retry_s=0,1,2")
    words = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=out")
    process = start(folder, *jobs, *words)
    status = wait_for(folder / "out" / "1", State.RUNNING)
    os.kill(status.pid, signal.SIGKILL)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 1, errors
    rows = table(folder / "out")
    assert [row["status"] for row in rows] == ["done", "killed", "done"]
    assert "killed by signal 9 (SIGKILL)" in rows[1]["error"]
    before = (folder / "out" / "0" / "metrics.json").stat().st_mtime_ns
    assert main([str(folder / "out")]) == 0
    assert "3 jobs: 3 done (2 of them before)" in capsys.readouterr().out
    assert (folder / "out" / "0" / "metrics.json").stat().st_mtime_ns == before
    assert {row["status"] for row in table(folder / "out")} == {"done"}


def test_stopped_sweep_goes_on_where_it_was_by_the_same_command(folder):
    jobs = (*SLOW, "policy.buffer_s=11,12", "hydra.sweep.dir=out")
    process = start(folder, *jobs)
    wait_for(folder / "out" / "0", State.RUNNING)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and "Traceback" not in errors
    assert {row["status"] for row in table(folder / "out")} == {"stopped"}
    code, out, errors = sweep(folder, *jobs)
    assert code == 0 and "2 jobs: 2 done" in out, errors
    code, out, _ = sweep(folder, *jobs)
    assert code == 0 and "(2 of them before)" in out


@pytest.mark.parametrize("subdir", ["0", "jobs/first"])
def test_sweep_that_was_moved_goes_on_where_it_is(folder, subdir):
    words = (*JOBS, "policy.retry_s=0", f"hydra.sweep.subdir={subdir}", "hydra.sweep.dir=out")
    assert sweep(folder, *words)[0] == 0
    (folder / "out").rename(folder / "moved")
    job = folder / "moved" / subdir
    Status.read(job).now(State.STOPPED).write(job)
    before_ns = (job / "metrics.json").stat().st_mtime_ns
    assert main([str(folder / "moved")]) == 0
    assert (job / "metrics.json").stat().st_mtime_ns > before_ns
    assert not (folder / "out").exists()


def test_sweep_that_runs_is_not_resumed_beside_itself(tmp_path, capsys):
    folders = ended(tmp_path, State.DONE)
    run_sweep(tmp_path, folders, {"backend": "basic"}, tmp_path)
    script = "import sys; from sceneslam.sweep.__main__ import main; sys.exit(main(sys.argv[1:]))"
    with closing(RunFolder.claim(tmp_path, kind="sweep")):
        words = [sys.executable, "-c", script, str(tmp_path)]
        own = os.environ | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(words, env=own, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and "a folder that no run is writing; process" in done.stderr
    assert main([str(tmp_path)]) == 0


def test_sweep_whose_working_folder_is_missing_is_named(tmp_path, capsys):
    folders = ended(tmp_path / "out", State.DONE)
    run_sweep(tmp_path / "out", folders, {"backend": "basic"}, tmp_path / "here")
    assert main([str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert (
        error.startswith("error: the folder in which the sweep began is missing")
        and "here" in error
    )


def test_job_whose_configuration_changed_is_run_again(folder):
    words = (*JOBS, "hydra.sweep.dir=out")
    assert sweep(folder, *words, "policy.retry_s=0,1")[0] == 0
    code, out, _ = sweep(folder, *words, "policy.retry_s=0,2")
    assert code == 0 and "2 jobs: 2 done (1 of them before)" in out
    assert [row["policy.retry_s"] for row in table(folder / "out")] == ["0", "2"]


def ended(sweep, *states):
    """Give the folders of jobs that ended in these states."""
    RunFolder.claim(sweep, kind="sweep").close()  # as Hydra's callback
    folders = [sweep / str(number) for number in range(len(states))]
    for folder, state in zip(folders, states, strict=True):
        folder.mkdir(parents=True)
        Status(state=state, overrides=[f"a={folder.name}"]).write(folder)
    return folders


def lacking(folder, *, faults=(), error="only 8 % got a pose"):
    """Give a job that ended with these failures of modules, and this error, its metrics."""
    metrics = {"faults": list(faults), "shortfalls": ["only 8 % got a pose"]}
    for place in (folder, folder / "reference"):
        place.mkdir(exist_ok=True)
        (place / "metrics.json").write_text(json.dumps(metrics))
    Status(state=State.INCOMPLETE, error=error, overrides=[f"a={folder.name}"]).write(folder)


@pytest.mark.parametrize(("last", "code"), [(State.DONE, 0), (State.INCOMPLETE, 1)])
def test_job_that_lacks_poses_is_told_by_the_exit_code_and_not_run_again(tmp_path, last, code):
    folders = ended(tmp_path, State.DONE, last)
    if last is State.INCOMPLETE:
        lacking(folders[1])
    assert run_sweep(tmp_path, folders, {"backend": "basic"}, tmp_path) is (code == 0)
    assert main([str(tmp_path)]) == code
    assert Status.read(folders[1]).state is last


@pytest.mark.parametrize(
    "why",
    [
        {"error": "the map could not all be saved: no space left; only 8 % got a pose"},
        {"faults": ["slam.bright was killed by signal 9 (SIGKILL)"]},
    ],
)
def test_job_that_a_cause_of_the_moment_left_incomplete_is_run_again(tmp_path, why):
    folders = ended(tmp_path, State.DONE, State.INCOMPLETE)
    lacking(folders[1], **why)
    assert not run_sweep(tmp_path, folders, {"backend": "basic"}, tmp_path)
    assert Status.read(folders[0]).state is State.DONE
    assert Status.read(folders[1]).state is State.FAILED  # it ran: there is nothing to run here


def test_job_that_lacks_poses_as_its_reference_does_is_final(tmp_path):
    error = "reference: only 8 % got a pose; only 8 % got a pose"
    lacking(tmp_path, error=error)
    assert Status.read(tmp_path).is_final(tmp_path)
    lacking(tmp_path, error=f"reference: slam.dark failed once; {error}")
    assert not Status.read(tmp_path).is_final(tmp_path)


def test_job_without_any_pose_is_final(tmp_path):
    lost = {"_target_": "fakes.ExactModule", "lost": list(range(200))}
    ran = run(config(slam__bright=lost, slam__dark=lost, run__report=False), tmp_path)
    errors = [*ran.faults, *ran.metrics["shortfalls"]]
    status = Status(state=State.INCOMPLETE, error="; ".join(errors))
    assert len(errors) == 1 and status.is_final(tmp_path)


def test_job_whose_reference_has_no_pose_is_final(tmp_path):
    error = "no pose: no scene was confirmed"
    (tmp_path / "reference").mkdir()
    metrics = {"faults": [], "errors": [error], "shortfalls": []}
    (tmp_path / "reference" / "metrics.json").write_text(json.dumps(metrics))
    assert Status(state=State.INCOMPLETE, error=f"reference: {error}").is_final(tmp_path)
    full = f"reference: {error}; reference: no space left"
    assert not Status(state=State.INCOMPLETE, error=full).is_final(tmp_path)


def test_job_that_a_stop_keeps_from_beginning_has_its_earlier_status(tmp_path, monkeypatch):
    def stop(_, orders):
        orders[0].stop.touch()
        for order in orders:
            run_job(order)

    monkeypatch.setattr(Basic, "run", stop)
    folders = ended(tmp_path, State.WAITING, State.INCOMPLETE, State.RUNNING)
    lacking(folders[1], error="the map could not all be saved: no space left")
    before = Status.read(folders[1])
    assert not run_sweep(tmp_path, folders, {"backend": "basic"}, tmp_path)
    assert Status.read(folders[1]) == before
    stopped = [Status.read(folder).state for folder in (folders[0], folders[2])]
    assert stopped == [State.STOPPED] * 2


@pytest.mark.parametrize("how", ["command", "resume"])
def test_job_of_a_damaged_recording_is_run_again_once_it_is_repaired(folder, how):
    recording = (folder / "room.mcap").resolve().read_bytes()
    (folder / "room.mcap").unlink()
    (folder / "room.mcap").write_bytes(recording[: len(recording) // 2])
    words = (*JOBS, "policy.retry_s=0,1", "hydra.sweep.dir=out")
    code, out, errors = sweep(folder, *words)
    assert code == 1 and "2 jobs: 2 incomplete" in out, errors
    (folder / "room.mcap").write_bytes(recording)
    if how == "command":
        code, out, errors = sweep(folder, *words)
        assert code == 0 and "2 jobs: 2 done" in out, errors
    else:
        assert main([str(folder / "out")]) == 0
    rows = table(folder / "out")
    assert [(row["status"], row["observations"]) for row in rows] == [("done", "30")] * 2


def test_table_holds_no_job_of_an_earlier_command(tmp_path, capsys):
    folders = ended(tmp_path, State.DONE, State.DONE, State.FAILED)
    run_sweep(tmp_path, folders[:2], {"backend": "basic"}, tmp_path)
    assert [row["job"] for row in table(tmp_path)] == ["0", "1"]
    assert main([str(tmp_path)]) == 0 and "2 jobs: 2 done" in capsys.readouterr().out


def test_sweep_takes_no_rows_of_an_earlier_one_of_the_detection_alone(folder):
    words = (*JOBS[:3], "policy.confirm_window_s=1", "hydra.sweep.dir=out")
    assert sweep(folder, *words, "run=detect_only")[0] == 0
    assert [row.status for row in read_rows(folder / "out")] == ["done"]
    sweep(folder, *words, JOBS[3], "policy.retry_s=-1")
    assert [row.status for row in read_rows(folder / "out")] == ["failed"]


def test_running_sweep_does_not_see_later_edits(folder):
    mine = folder / "mine" / "policy" / "mine.yaml"
    mine.parent.mkdir(parents=True)
    mine.write_text("defaults: [default]\nretry_s: 0.25\n")
    words = ("--config-dir", "mine", *SLOW, "policy=mine", "policy.buffer_s=11,12")
    process = start(folder, *words, "hydra.sweep.dir=out")
    wait_for(folder / "out" / "0", State.RUNNING)
    mine.write_text("defaults: [default]\nretry_s: 0.75\n")
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    for job in ("0", "1"):
        assert "retry_s: 0.25" in (folder / "out" / job / "config.yaml").read_text()
    (code,) = (folder / "out" / ".sweep" / "code").iterdir()
    assert (code / "sceneslam" / "sweep" / "job.py").is_file()


@pytest.mark.parametrize(
    "name", ["experiments/mine.py", "sceneslam/page.html", "conf/mine.yaml", "modules/mine.py"]
)
def test_an_edit_of_whatever_is_copied_makes_another_copy(tmp_path, monkeypatch, name):
    for part in ("sceneslam", "conf", "modules", "experiments"):
        (tmp_path / "root" / part).mkdir(parents=True)
    (tmp_path / "root" / "pyproject.toml").write_text("")
    places = [str(tmp_path / "root" / "sceneslam"), str(tmp_path / "root")]
    monkeypatch.setattr("sceneslam.__path__", places)
    edited = tmp_path / "root" / name
    edited.write_text("old")
    first = keep_code(tmp_path / "code")
    assert keep_code(tmp_path / "code") == first and (first / name).read_text() == "old"
    edited.write_text("new")
    assert (keep_code(tmp_path / "code") / name).read_text() == "new"


def test_folders_that_collide_are_refused(folder):
    code, _, errors = sweep(folder, *MIXED, "hydra.sweep.dir=out", "hydra.sweep.subdir=same")
    assert code == 2 and "hydra.sweep.subdir: got 'same'" in errors
    assert not list((folder / "out").glob("*/metrics.json"))


def test_jobs_that_would_lose_maps_of_each_other_are_refused(folder):
    code, _, errors = sweep(folder, *MIXED, "atlas.save=map", "hydra.sweep.dir=out")
    assert code == 2 and errors.startswith("error: atlas.save: got 'map', allowed: a folder of its")
    assert not (folder / "map").exists() and not (folder / "out").exists()


@pytest.mark.parametrize(
    ("maps", "is_allowed"),
    [
        ([("a", None), ("b", None)], True),
        ([("a", None), ("a/", None)], False),
        ([("a", "a"), ("a", "a")], True),  # one run after the other extends it
        ([("a", "b"), ("a", "b")], False),
        ([(None, "b"), (None, "b")], True),
    ],
)
def test_maps_of_runs_that_are_composed_together_stay_apart(maps, is_allowed):
    runs = [{"save": save, "load": load} for save, load in maps]
    with nullcontext() if is_allowed else pytest.raises(ConfigError, match=r"atlas\.save: got 'a"):
        check_maps_apart(runs)


def test_maps_in_one_folder_are_found_under_each_of_its_names(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(ConfigError, match=r"atlas\.save: got '~/map'"):
        check_maps_apart([{"save": str(tmp_path / "map")}, {"save": "~/map"}])
    check_maps_apart([{"save": str(tmp_path / "map"), "load": "~/map"}] * 2)


@pytest.mark.parametrize("kind", ["run", "sweep"])
def test_a_run_and_a_sweep_share_no_folder(folder, kind):
    RunFolder.claim(folder / "out", kind=kind).close()
    if kind == "run":
        code, _, errors = sweep(folder, *MIXED, "hydra.sweep.dir=out")
    else:
        words = [sys.executable, "-m", "sceneslam", *JOBS, "hydra.run.dir=out"]
        own = os.environ | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(words, cwd=folder, env=own, capture_output=True, text=True)
        code, errors = done.returncode, done.stderr
    assert code == 2 and f"it is the folder of a {kind}" in errors
    assert [path.name for path in (folder / "out").iterdir()] == [MARK]


def test_job_that_a_real_time_signal_ends_is_settled(tmp_path):
    program = tmp_path / "code" / "sceneslam" / "sweep" / "job.py"
    program.parent.mkdir(parents=True)
    program.write_text("import os\nos.kill(os.getpid(), 40)\n")
    for folder in program.parents[:2]:
        (folder / "__init__.py").touch()
    code, stop = tmp_path / "code", tmp_path / "stop"
    run_job(JobOrder(folder=tmp_path, code=code, began_in=tmp_path, stop=stop))
    status = Status.read(tmp_path)
    assert status.state is State.KILLED and "killed by signal 40" in status.error


def test_folder_that_is_no_sweep_is_named(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "not the folder of a sweep" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", '{"launcher": {', "[]", "{}", '{"launcher": 3}'])
def test_a_sweep_whose_file_is_damaged_is_named(tmp_path, capsys, text):
    (tmp_path / ".sweep").mkdir()
    (tmp_path / ".sweep" / "sweep.json").write_text(text)
    assert main([str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: the sweep's file is damaged") and "sweep.json" in error


@pytest.mark.parametrize("is_deleted", [True, False])
def test_a_job_that_is_deleted_or_empty_is_named_and_run_by_the_same_command(
    folder, capsys, is_deleted
):
    words = (*JOBS, "policy.retry_s=0", "hydra.sweep.dir=out")
    assert sweep(folder, *words)[0] == 0
    if is_deleted:
        shutil.rmtree(folder / "out" / "0")
    else:
        (folder / "out" / "0" / "job.json").write_text("")
    assert main([str(folder / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: a job's folder or status is missing (give the sweep's command")
    code, out, errors = sweep(folder, *words)
    assert code == 0 and "1 jobs: 1 done" in out, errors


def test_the_file_of_a_sweep_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    def fail(descriptor):
        raise OSError("no space left on device")

    with pytest.raises(InputError, match="no run in the folder"):
        run_sweep(tmp_path, [], {"backend": "basic"}, tmp_path)
    before = (tmp_path / ".sweep" / "sweep.json").read_text()
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        run_sweep(tmp_path, [], {"backend": "joblib", "n_jobs": 2, "cpus_per_job": 1}, tmp_path)
    assert (tmp_path / ".sweep" / "sweep.json").read_text() == before


@pytest.mark.parametrize(
    ("backend", "cores"),
    [(Basic(), None), (Joblib(n_jobs=2, cpus_per_job=1), 1), (Joblib(n_jobs=2, cpus_per_job=4), 4)],
)
def test_jobs_are_told_how_many_cores_they_may_take(backend, cores, tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr("sceneslam.sweep.backends.run_job", told.append)
    order = JobOrder(folder=tmp_path, code=tmp_path, began_in=tmp_path, stop=tmp_path / "stop")
    backend.run([order] * 5)
    assert [order.cores for order in told] == [cores] * 5


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Joblib(n_jobs=0, cpus_per_job=1), "n_jobs"),
        (lambda: Joblib(n_jobs=None, cpus_per_job=1), "n_jobs"),
        (lambda: Joblib(n_jobs=1, cpus_per_job=0), "cpus_per_job"),
        (lambda: Joblib(n_jobs=1, cpus_per_job=None), "cpus_per_job"),
        (lambda: Ray(address=None, num_cpus=None, cpus_per_job=None), "cpus_per_job"),
        (lambda: Ray(address=None, num_cpus=-1, cpus_per_job=1), "num_cpus"),
        (lambda: Submitit("local", array_parallelism=-1, parameters={}), "array_parallelism"),
        (lambda: Submitit("local", array_parallelism=1, parameters=None), "parameters"),
    ],
)
def test_impossible_worker_is_named(make, key):
    with pytest.raises(ConfigError, match=key):
        make()


@pytest.mark.parametrize(
    ("backend", "sentence"),
    [
        (Submitit("slurm", None, {}), "hydra.launcher.cluster: got 'slurm'"),
        (Submitit("local", None, {"nodez": 2}), "hydra.launcher.parameters: got {'nodez': 2}"),
        (Ray("nowhere", None, 1), "hydra.launcher.address: got 'nowhere'"),
    ],
)
def test_cluster_that_cannot_be_used_is_named(backend, sentence, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))  # a machine that has SLURM has none here
    order = JobOrder(folder=tmp_path, code=tmp_path, began_in=tmp_path, stop=tmp_path / "stop")
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        backend.run([order])


def test_sigterm_stops_a_sweep_with_ray_in_order(tmp_path, monkeypatch):
    before, stop = signal.getsignal(signal.SIGTERM), tmp_path / "stop"

    def stopped(running):
        signal.raise_signal(signal.SIGTERM)
        assert stop.exists()
        return running, []

    ray = SimpleNamespace(
        init=lambda *given, **named: signal.signal(signal.SIGTERM, signal.SIG_IGN),
        remote=lambda **named: lambda job: SimpleNamespace(remote=lambda order: order),
        wait=stopped,
        get=lambda order: None,
        shutdown=lambda: signal.signal(signal.SIGTERM, before),
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    order = JobOrder(folder=tmp_path, code=tmp_path, began_in=tmp_path, stop=stop)
    with termination_noted(lambda: None):
        Ray(None, None, 1).run([order])
    assert signal.getsignal(signal.SIGTERM) == before


def test_status_is_read_as_it_was_written(tmp_path):
    status = Status(state=State.KILLED, error="why", overrides=["seed=1"], wall_s=1.5, pid=3)
    status.write(tmp_path)
    assert Status.read(tmp_path) == status
    assert json.loads((tmp_path / "job.json").read_text())["state"] == "killed"


def commands():
    text = (ROOT / "docs" / "sweeps.md").read_text().replace("\\\n", " ")
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.S)).splitlines()
    return [line for line in lines if "sceneslam -m" in line]


@pytest.mark.parametrize("line", commands())
def test_command_of_the_guide_composes(line):
    words = shlex.split(line)[4:]
    (jobs,) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(words), None)
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        for job in (jobs[0], jobs[-1]):
            config = compose("config", overrides=[w for w in job if not w.startswith("hydra/")])
            check_keys(OmegaConf.to_container(config, resolve=True))


@pytest.mark.parametrize("name", ["threshold_sweep", "window_sweep", "detection_sweep"])
def test_shipped_sweep_composes_at_both_ends(name):
    with initialize_config_module("sceneslam.conf", version_base="1.3"):
        whole = compose("config", overrides=[f"+experiment={name}"], return_hydra_config=True)
        params = [f"{key}={value}" for key, value in whole.hydra.sweeper.params.items()]
        parsed = OverridesParser.create().parse_overrides([f"+experiment={name}", *params])
        (jobs,) = BasicSweeper.split_arguments(parsed, None)
        assert len(jobs) == {"detection_sweep": 3 * 60 * 9}.get(name, 24)
        for job in (jobs[0], jobs[-1]):
            check_keys(OmegaConf.to_container(compose("config", overrides=job), resolve=True))
