"""The process that works beside the rgbd module's tracking, and how it ends."""

import gc
import os
import signal
import threading
from pathlib import Path

import pytest

from sceneslam.modules.slam.rgbd.see.side_process import SideProcess
from sceneslam.types.errors import ModuleError


class Counter:
    """Counts its tasks: the state that stays in the process."""

    def __init__(self, start):
        self.count = start

    def __call__(self, task):
        if task == "pid":
            return os.getpid()
        self.count += task
        return self.count


def runs(pid):
    return Path(f"/proc/{pid}").exists()


def test_side_process_does_tasks_in_order_and_keeps_its_state():
    process = SideProcess(Counter, 10)
    answers = [process.submit(task) for task in (1, 2, 3)]
    assert [answer.result() for answer in answers] == [11, 13, 16]
    pid = process.submit("pid").result()
    assert pid != os.getpid()
    process.end()
    process.end()
    assert not runs(pid)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_side_process_leaves_requests_to_stop_to_its_parent(number):
    process = SideProcess(Counter, 0)
    os.kill(process.submit("pid").result(), number)
    assert process.submit(1).result() == 1
    process.end()


def test_side_process_that_was_killed_is_a_module_error():
    process = SideProcess(Counter, 0)
    os.kill(process.submit("pid").result(), signal.SIGKILL)
    with pytest.raises(ModuleError, match="has ended"):
        process.submit(1).result()
    process.end()


def test_side_process_ends_with_what_owned_it():
    process = SideProcess(Counter, 0)
    pid = process.submit("pid").result()
    del process
    gc.collect()
    assert not runs(pid)


def test_side_process_ends_in_whichever_thread_drops_it():
    kept = [SideProcess(Counter, 0)]
    pid = kept[0].submit("pid").result()
    dropped = threading.Event()

    def drop(_):
        kept.clear()  # in the process's own thread, which cannot wait for itself
        dropped.set()

    kept[0].submit(1).add_done_callback(drop)
    assert dropped.wait(30)
    assert not runs(pid)
