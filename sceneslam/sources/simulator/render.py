"""Rendering of all frames of a shot, in order, by several processes."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Generator
from typing import IO

import cv2

from sceneslam.sources.simulator.shot import Photographer, Shot, SimulatedFrame
from sceneslam.types.errors import InputError


def render(shot: Shot, count: int, workers: int) -> Generator[SimulatedFrame]:
    """Yield frames 0 to count - 1; they do not depend on the number of workers.

    Raises InputError when a worker dies.
    """
    if workers == 1 or count < 2:
        photographer = Photographer(shot)
        for index in range(count):
            yield photographer.take(index)
        return
    crew = [_hire() for _ in range(workers)]
    try:
        for number, worker in enumerate(crew):
            _brief(worker, shot, range(number, count, workers))
        for index in range(count):
            yield _receive(crew[index % workers], index)
    finally:
        for worker in crew:
            worker.kill()
            worker.communicate()


def work() -> None:
    """Render the frames that standard input lists, and write them to standard output."""
    cv2.setNumThreads(1)
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as output:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # for output of libraries
        shot, share = pickle.load(sys.stdin.buffer)
        photographer = Photographer(shot)
        for index in share:
            pickle.dump(photographer.take(index), output, protocol=5)
            output.flush()


def _hire() -> subprocess.Popen[bytes]:
    """Start a worker.

    Workers are processes, since ray casting holds the GIL. `multiprocessing` is not used: it runs
    the caller's main module in each. They have their own session, which Ctrl-C does not reach.
    """
    command = f"from {__name__} import work; work()"
    return subprocess.Popen(
        [sys.executable, "-c", command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        start_new_session=True,
    )


def _brief(worker: subprocess.Popen[bytes], shot: Shot, share: range) -> None:
    assert worker.stdin is not None
    try:
        pickle.dump((shot, share), worker.stdin, protocol=5)
        worker.stdin.flush()
    except BrokenPipeError:
        raise InputError("the simulator: a rendering process could not start") from None


def _receive(worker: subprocess.Popen[bytes], index: int) -> SimulatedFrame:
    output: IO[bytes] | None = worker.stdout
    assert output is not None
    try:
        frame = pickle.load(output)
    except (EOFError, pickle.UnpicklingError):
        raise InputError(f"the simulator: a rendering process ended at frame {index}") from None
    assert isinstance(frame, SimulatedFrame)
    return frame
