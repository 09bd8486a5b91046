"""A worker process: many small NumPy calls in a thread would delay the tracking."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import IO, Any, Generic, TypeVar
from weakref import finalize

from sceneslam.types.errors import ModuleError

Task = TypeVar("Task")
Result = TypeVar("Result")
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}


class SideProcess(Generic[Task, Result]):
    """Does tasks one after the other with an object that is built, and kept, in the process.

    It does not use multiprocessing, which runs the caller's main module again. The process ends
    with this object and with its parent, in whatever way that ends, because its input is closed
    then.
    """

    def __init__(self, build: Callable[..., Callable[[Task], Result]], *arguments: object) -> None:
        """Start the process without waiting until it runs."""
        main = f"import sys; sys.path[:] = sys.argv[1:]; from {__name__} import main; main()"
        popen = subprocess.Popen(
            [sys.executable, "-P", "-c", main, *sys.path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | _ONE_THREAD,
            start_new_session=True,  # a terminal's Ctrl-C is the parent's to handle
        )
        line = ThreadPoolExecutor(max_workers=1, thread_name_prefix="rgbd-mapping")
        line.submit(_send, popen.stdin, (build, arguments))
        self._popen, self._line = popen, line
        self._end = finalize(self, _end, popen, line)

    def submit(self, task: Task) -> Future[Result]:
        """Submit a task and return at once; the future raises ModuleError if the process ended."""
        return self._line.submit(_ask, self._popen, task)

    def end(self) -> None:
        """End the process, even during a task; may be called twice. No thread remains."""
        self._end()
        self._line.shutdown(wait=True)


def main() -> None:
    """Process tasks from standard input until it is closed; answers go to standard output.

    Requests to stop are the parent's to handle, which still waits for answers.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever a library prints
    build, arguments = pickle.load(sys.stdin.buffer)
    work = build(*arguments)
    while True:
        try:
            _send(output, work(pickle.load(sys.stdin.buffer)))
        except (EOFError, BrokenPipeError):  # the parent ended
            return


def _ask(popen: subprocess.Popen[bytes], task: Any) -> Any:
    assert popen.stdout is not None
    try:
        _send(popen.stdin, task)
        return pickle.load(popen.stdout)
    except (OSError, EOFError, ValueError, pickle.UnpicklingError) as error:
        raise ModuleError("rgbd: the process that adjusts its map has ended") from error


def _send(stream: IO[bytes] | None, value: Any) -> None:
    assert stream is not None
    pickle.dump(value, stream, protocol=5)
    stream.flush()


def _end(popen: subprocess.Popen[bytes], line: ThreadPoolExecutor) -> None:
    """Kill the process; no zombie or open pipe remains.

    It joins no thread: the garbage collector may call it in any, whatever lock that holds.
    """
    popen.kill()
    line.shutdown(wait=False, cancel_futures=True)
    popen.wait()
    for stream in (popen.stdin, popen.stdout):
        assert stream is not None
        with suppress(BrokenPipeError):  # what had not been sent
            stream.close()
