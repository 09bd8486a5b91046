"""Ctrl-C, SIGTERM and SIGHUP while a run ends and its results are saved."""

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path

import pytest
from configured import config
from fakes import ExactModule
from tqdm import tqdm

from sceneslam.app import run
from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.bus import Bus
from sceneslam.experiment import _end_with, _run_unless_finished
from sceneslam.interrupts import StopRequests
from sceneslam.keeping import Keeping
from sceneslam.recover.recover import recover
from sceneslam.results import Results
from sceneslam.types.trajectory import Trajectory

ROOT = Path(__file__).parents[1]


@pytest.fixture
def pressing(monkeypatch):
    """Send signals to this process when the run is at a step for the first time."""

    def press(owner, step, *numbers):
        before, left = getattr(owner, step), [*numbers]

        def pressed(*given, **named):
            while left:
                signal.raise_signal(left.pop(0))
            return before(*given, **named)

        monkeypatch.setattr(owner, step, pressed)

    return press


def answer_count(caplog):
    return sum("results are being saved" in one.getMessage() for one in caplog.records)


SAVING = [(Bus, "close"), (Atlas, "finish"), (Results, "save_rest")]


@pytest.mark.parametrize(("owner", "step"), SAVING)
def test_ctrl_c_while_results_are_saved_is_answered_and_costs_none(
    tmp_path, pressing, caplog, owner, step
):
    pressing(owner, step, signal.SIGINT)
    finished = run(config(run__report=False), tmp_path)
    assert answer_count(caplog) == 1 and str(tmp_path) in caplog.text
    assert finished.faults == () and len(finished.trajectory) == 100
    assert not finished.is_interrupted and finished.is_stop_requested
    assert (tmp_path / "map" / "points.ply").exists()
    assert not (tmp_path / "journal.bin").exists()


@pytest.mark.parametrize(("owner", "step"), SAVING)
def test_second_ctrl_c_while_results_are_saved_ends_the_run_and_recover_has_the_poses(
    tmp_path, pressing, owner, step
):
    before = signal.getsignal(signal.SIGINT)
    pressing(owner, step, signal.SIGINT, signal.SIGINT)
    is_there = step == "save_rest"
    left = "the trajectory is in" if is_there else r"python -m sceneslam\.recover"
    with pytest.raises(KeyboardInterrupt, match=left):
        run(config(run__report=False), tmp_path)
    assert signal.getsignal(signal.SIGINT) == before
    assert not (tmp_path / "metrics.json").exists() and not (tmp_path / "reserve.bin").exists()
    assert (tmp_path / "trajectory.tum").exists() is is_there
    assert recover(tmp_path).faults == ()
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 100


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_saving_is_ended_by_no_other_signal(tmp_path, pressing, caplog, number):
    pressing(Atlas, "finish", number, number, signal.SIGINT, number)
    finished = run(config(run__report=False), tmp_path)
    assert answer_count(caplog) == 1 and finished.is_stop_requested
    assert finished.faults == () and len(finished.trajectory) == 100


def test_ctrl_c_pressed_twice_ends_the_run_once_and_saves_it(tmp_path, pressing, caplog):
    pressing(Keeping, "keep", signal.SIGINT)  # which ends the run
    pressing(tqdm, "close", signal.SIGINT)  # while that is being ended
    finished = run(config(run__report=False), tmp_path)
    assert finished.is_interrupted and answer_count(caplog) == 1
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 1


def test_ctrl_c_that_ends_what_hangs_at_the_end_of_a_run_costs_no_result(tmp_path, pressing):
    pressing(Keeping, "keep", signal.SIGINT)
    pressing(tqdm, "close", signal.SIGINT, signal.SIGINT)
    finished = run(config(run__report=False), tmp_path)
    assert finished.is_interrupted
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 1


def test_a_module_that_catches_the_request_to_stop_does_not_keep_the_run(tmp_path, monkeypatch):
    track = ExactModule.track

    def deaf(self, observation):
        with suppress(BaseException):
            signal.raise_signal(signal.SIGTERM)
        return track(self, observation)

    monkeypatch.setattr(ExactModule, "track", deaf)
    finished = run(config(run__report=False), tmp_path)
    assert finished.is_interrupted
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 1


@pytest.mark.usefixtures("heeds_ctrl_c")
@pytest.mark.parametrize("times", [1, 2, 3])
def test_live_run_saves_nothing_beside_the_step_that_ctrl_c_interrupted(
    tmp_path, monkeypatch, times
):
    monkeypatch.setattr("sceneslam.engine.live._RAISE_S", 0.0)
    keep, finish, is_left, order = Keeping.keep, Atlas.finish, threading.Event(), []

    def slow(self):
        for _ in range(times):
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            is_left.wait(0.3)
        keep(self)
        order.append("stepped")

    def finished(self):
        order.append("saves")
        return finish(self)

    monkeypatch.setattr(Keeping, "keep", slow)
    monkeypatch.setattr(Atlas, "finish", finished)
    settings = config(run__report=False, run__mode="live", run__rate=0.1)
    if times < 3:
        assert run(settings, tmp_path).is_interrupted
        assert order == ["stepped", "saves"]
        return
    with pytest.raises(KeyboardInterrupt, match=r"python -m sceneslam\.recover"):
        run(settings, tmp_path)
    assert "saves" not in order and not (tmp_path / "trajectory.tum").exists()


@pytest.mark.usefixtures("heeds_ctrl_c")
def test_live_run_is_saved_without_the_module_that_does_not_return(tmp_path, monkeypatch):
    is_left, track = threading.Event(), ExactModule.track

    def stuck(self, observation):
        if observation.stamp_ns:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGTERM)
            is_left.wait(60.0)
        return track(self, observation)

    monkeypatch.setattr("sceneslam.engine.live._STEP_S", 0.3)
    monkeypatch.setattr("sceneslam.engine.live._RAISE_S", 0.1)
    monkeypatch.setattr(ExactModule, "track", stuck)
    finished = run(config(run__report=False, run__mode="live"), tmp_path)
    is_left.set()
    assert finished.is_interrupted and "stopped after 1 observations" in finished.faults[0]
    (sentence,) = finished.metrics["shortfalls"]
    assert "slam.bright failed once at 0.0 s: did not return from a call" in sentence
    assert len(Trajectory.read_tum(tmp_path / "trajectory.tum")) == 1
    assert (tmp_path / "map" / "points.ply").exists()
    assert not (tmp_path / "journal.bin").exists()


def test_ctrl_c_after_the_last_observation_costs_no_result(tmp_path, pressing):
    pressing(StopRequests, "end_run", signal.SIGINT)
    finished = run(config(run__report=False), tmp_path)
    assert finished.is_stop_requested and len(finished.trajectory) == 100
    assert not (tmp_path / "journal.bin").exists()


def test_trial_that_was_saved_is_kept_but_no_other_trial_follows_ctrl_c(tmp_path, pressing):
    settings, folder = config(run__report=False), tmp_path / "trial"
    pressing(Results, "save_rest", signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="after the trial"):
        _run_unless_finished(settings, folder, "trial")
    assert (folder / "finished.json").exists()
    written_ns = (folder / "trajectory.tum").stat().st_mtime_ns
    _run_unless_finished(settings, folder, "trial")
    assert (folder / "trajectory.tum").stat().st_mtime_ns == written_ns


def pressed(folder, times, *overrides):
    """Run a command with Ctrl-C pressed while its results are saved."""
    sink = f"+sinks.presser={{_target_:fakes.Presser,times:{times}}}"
    words = ["+scenario=single", "source=mcap", "source.path=room.mcap", "run.report=false"]
    words += ["slam@slam.only=odometry", "allow_targets=[fakes]", "hydra.run.dir=out", sink]
    return subprocess.run(
        [sys.executable, "-m", "sceneslam", *words, *overrides],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"},
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize("times", [1, 2])
def test_command_answers_ctrl_c_while_it_saves(folder, times):
    done = pressed(folder, times)
    assert done.stderr.count("the results are being saved") == 1
    assert ("error: stopped while the results" in done.stderr) is (times == 2)
    assert "Traceback" not in done.stderr and done.returncode == times - 1
    assert (folder / "out" / "metrics.json").exists() is (times == 1)


SLOW_START = """
import contextlib
import signal
import sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it
from sceneslam import __main__ as program
def press(*_, **__):
    signal.raise_signal(signal.SIGINT)
def spoilt(*_, **__):
    try:
        press()
    except KeyboardInterrupt:
        raise ImportError("initialization failed") from None  # as pybind11
def lost(*given, **named):
    from sceneslam.config.build import build
    with contextlib.suppress(KeyboardInterrupt):
        press()
    return build(*given, **named)
sys.argv[1:] = ["+scenario=single", "run.report=false"]
exec(sys.stdin.read())
program.main()
"""


@pytest.mark.parametrize(
    "pressed_in",
    [
        "program.register = press",
        "from hydra._internal.hydra import Hydra; Hydra.compose_config = press",
        "from hydra._internal.hydra import Hydra; Hydra.compose_config = spoilt",
        "program.cli.check_trust = press",
        "program.cli.check_trust = spoilt",
        "import sceneslam.app; sceneslam.app.build = spoilt",
        "import sceneslam.app; sceneslam.app.build = lost",
    ],
)
def test_ctrl_c_before_the_first_observation_is_one_sentence(tmp_path, pressed_in):
    done = subprocess.run(
        [sys.executable, "-c", SLOW_START],
        input=pressed_in,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert done.stderr == "error: stopped before the first observation\n"


def test_threads_that_a_module_leaves_running_are_named_and_do_not_delay_the_exit(folder):
    done = pressed(folder, 0, "~slam.only", "+slam.only={_target_:fakes.LingeringModule}")
    assert done.returncode == 0
    assert "ended with the process: thread lingering, lingering_0\n" in done.stderr


def test_threads_that_a_trial_leaves_running_do_not_keep_the_experiment(capfd):
    context = get_context("spawn")
    reader, writer = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(1, context, initializer=_end_with, initargs=(reader,))
    with reader, writer, pool:
        pool.submit(exec, "from fakes import LingeringModule; LingeringModule()").result()
    assert "ended with the process: thread lingering, lingering_0\n" in capfd.readouterr().err


def test_ctrl_c_while_the_reference_is_saved_is_before_the_run_itself(folder):
    done = pressed(folder, 1, "reference={seed:1}")
    assert done.returncode == 1 and "stopped before the first observation" in done.stderr
    assert (folder / "out" / "reference" / "metrics.json").exists()
    assert not (folder / "out" / "trajectory.tum").exists()
