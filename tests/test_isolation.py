"""A module in a process of its own: what it does to itself, it does to nobody else."""

import gc
import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fakes import RIG, ClosingModule, ExactModule, observation
from isolation import Harmful, Hoarder, harmful, isolating, limits

from sceneslam.interfaces import ClosesLoops
from sceneslam.supervision.isolated import IsolatedModule
from sceneslam.types.errors import ConfigError, ModuleError


@pytest.fixture
def isolated():
    with isolating() as isolated:
        yield isolated


def seen(index, grey=0):
    return replace(observation(index), image_bgr=np.full((240, 320, 3), grey, np.uint8))


def active(module):
    module.activate(RIG)
    module.set_scene("Bright")
    return module


def drive_into(module, steps=4):
    for index in range(steps):
        module.track(seen(index))


def process_ids():
    """Return the processes that this one started, dead ones included."""
    path = Path(f"/proc/{os.getpid()}/task")
    return {pid for task in path.iterdir() for pid in (task / "children").read_text().split()}


def test_poses_are_those_of_the_module_itself(isolated):
    module, inline = active(isolated(ExactModule)), active(ExactModule())
    for index in range(5):
        answer, expected = module.track(seen(index)), inline.track(seen(index))
        np.testing.assert_array_equal(answer.T_local_base, expected.T_local_base)
        assert answer.status is expected.status and answer.stamp_ns == expected.stamp_ns


@pytest.mark.parametrize("closes", [True, False])
def test_a_module_tells_from_its_process_whether_it_closes_loops(isolated, closes):
    module = isolated(partial(ClosingModule, closes))
    assert isinstance(module, ClosesLoops) and module.closes_loops is closes
    assert module.requires == ExactModule.requires
    assert not isolated(ExactModule).closes_loops


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("be_killed", r"was killed by signal 9 \(SIGKILL\)"),
        ("crash", r"was killed by signal 11 \(SIGSEGV\)"),
        ("really_leave", "ended by itself with exit code 3"),
        ("flood_memory", "used more than 500 MB"),
    ],
)
def test_the_end_of_a_process_is_named_and_survived(isolated, how, what):
    module = active(isolated(harmful(how), memory_limit_mb=500))
    with pytest.raises(ModuleError, match=what):
        drive_into(module)
    with pytest.raises(ModuleError, match="its process ended, and the session with it"):
        module.get_map()
    active(module)
    assert module.track(seen(0)).T_local_base.shape == (4, 4)


@pytest.mark.parametrize("how", ["hang", "hang_in_native_code"])
def test_a_hanging_process_is_ended_at_its_deadline(isolated, how):
    module = active(isolated(harmful(how), step_deadline_s=0.5))
    began_s = time.monotonic()
    with pytest.raises(ModuleError, match=r"did not answer within 0\.5 s"):
        drive_into(module)
    assert time.monotonic() - began_s < 5.0
    assert active(module).track(seen(0)) is not None


@pytest.mark.parametrize(
    ("how", "kind", "what"),
    [
        ("leave", ModuleError, "SystemExit: 3"),
        ("raise_what_cannot_travel", ModuleError, "OddError: left and right"),
        ("answer_what_cannot_travel", ModuleError, "its answer: .*pickle"),
        ("no_such_thing", AttributeError, "no attribute 'no_such_thing'"),
    ],
)
def test_what_a_module_raises_is_raised_and_its_process_goes_on(isolated, how, kind, what):
    module = active(isolated(harmful(how)))
    with pytest.raises(kind, match=what):
        drive_into(module)
    np.testing.assert_allclose(module.track(seen(0)).T_local_base, np.eye(4), atol=1e-12)


def test_the_traceback_of_the_other_process_is_told(isolated):
    module = active(isolated(harmful("no_such_thing")))
    with pytest.raises(AttributeError) as caught:
        drive_into(module)
    assert "return getattr(self, self._how)()" in str(caught.value.__cause__)


def test_what_a_module_logs_is_logged_here(isolated, caplog):
    drive_into(active(isolated(harmful("complain"))))
    assert ("modules.harmful", logging.WARNING, "the lens is dirty") in caplog.record_tuples


def test_images_that_a_module_keeps_stay_what_they_were(isolated):
    module = active(isolated(Hoarder))
    for index in range(20):
        module.track(seen(index, grey=10 * index))
    np.testing.assert_array_equal(module.get_trajectory(), 10.0 * np.arange(20))


def test_images_that_a_module_drops_leave_their_memory_to_the_next(isolated):
    module = active(isolated(ExactModule))
    for index in range(20):
        module.track(seen(index))
    gc.collect()
    assert 1 <= Path("/proc/self/maps").read_text().count("memfd:sceneslam") <= 2


def test_several_modules_track_at_once(isolated):
    one, two = active(isolated(harmful("hang"))), active(isolated(ExactModule))
    one.submit(seen(0))
    two.submit(seen(0))
    assert two.collect().stamp_ns == one.collect().stamp_ns == 0


def test_an_answer_that_an_interrupt_left_behind_is_passed_over(isolated):
    module = active(isolated(ExactModule))
    module.submit(seen(0))
    module.submit(seen(1))
    assert module.collect().stamp_ns == seen(1).stamp_ns


def test_a_module_that_cannot_be_built_says_why(isolated):
    def requires(make):
        return isolated(make).requires

    with pytest.raises(TypeError, match="unexpected keyword argument 'speed'"):
        requires(partial(ExactModule, speed=3))
    with pytest.raises(ConfigError, match="lens: got 'dirty', allowed: 'clean'"):
        requires(refuse)
    with pytest.raises(ModuleError, match="ended by itself with exit code 4"):
        requires(partial(os._exit, 4))


def refuse():
    raise ConfigError("lens", "dirty", "'clean'")


def test_restarts_are_bounded(isolated):
    module = isolated(harmful("be_killed", at=0), restarts_max=2)
    for _ in range(3):
        with pytest.raises(ModuleError, match="SIGKILL"):
            active(module).track(seen(0))
        module.note_failure()
    assert module.is_spent and not module.is_ready
    with pytest.raises(ModuleError, match="failed more than 2 times within 60 s"):
        module.activate(RIG)


def test_a_process_is_ready_again_without_being_waited_for(isolated):
    module = active(isolated(harmful("be_killed", at=0)))
    assert module.is_ready
    with pytest.raises(ModuleError):
        module.track(seen(0))
    assert not module.is_ready
    while not module.is_ready:
        pass
    assert active(module).track(seen(1)) is not None


def test_the_death_of_an_idle_process_costs_nothing(isolated):
    before = process_ids()  # a worker of an earlier test may still be on its way out
    module = active(isolated(ExactModule))
    module.shutdown()
    (pid,) = process_ids() - before
    os.kill(int(pid), signal.SIGKILL)
    while Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z":
        pass
    assert active(module).track(seen(0)) is not None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_requests_to_stop_are_left_to_the_parent(isolated, number):
    before = process_ids()
    module = active(isolated(ExactModule))
    module.track(seen(0))
    (pid,) = process_ids() - before
    os.kill(int(pid), number)
    assert module.track(seen(1)) is not None and module.get_map() is not None


def test_no_process_is_left_behind(isolated):
    before = process_ids()
    kept, dropped = isolated(ExactModule), IsolatedModule("x", ExactModule, limits())
    assert kept.requires == dropped.requires and len(process_ids() - before) == 2
    kept.close()
    kept.close()
    del dropped
    gc.collect()
    assert process_ids() == before


def test_a_file_of_the_users_does_not_shadow_what_python_starts_with(
    isolated, tmp_path, monkeypatch
):
    (tmp_path / "re.py").write_text("raise AssertionError")
    monkeypatch.syspath_prepend(tmp_path)
    assert isolated(ExactModule).requires == ExactModule.requires


PARENT = """
import sys, time
from functools import partial
from isolation import Harmful, limits
from fakes import RIG, observation
from sceneslam.supervision.isolated import IsolatedModule

module = IsolatedModule("slam.orphan", partial(Harmful, "hang_in_native_code", at=0), limits())
module.activate(RIG)
module.submit(observation(0))
(pid,) = open("/proc/self/task/%d/children" % __import__("os").getpid()).read().split()
print(pid, flush=True)
time.sleep(1000)
"""


def test_a_process_does_not_outlive_a_parent_that_is_killed():
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    with subprocess.Popen(
        [sys.executable, "-c", PARENT],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    ) as parent:
        pid = parent.stdout.readline().strip()
        parent.kill()
    deadline_s = time.monotonic() + 10.0
    while is_running(pid) and time.monotonic() < deadline_s:
        pass
    assert not is_running(pid)


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] not in "ZX"
    except FileNotFoundError:
        return False


def test_harm_is_what_the_tests_mean_by_it():
    with pytest.raises(SystemExit):
        drive_into(active(Harmful("leave")))
