"""Rendering all frames of a shot, in order, by as many processes as wanted."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Generator, Sequence
from multiprocessing.connection import Connection

import cv2

from sceneslam.sources.two_rooms.shot import Frame, Photographer, Shot
from sceneslam.types.errors import InputError


def render(shot: Shot, count: int, workers: int) -> Generator[Frame]:
    """Yield frames 0 to count - 1; their bytes do not depend on the number of workers.

    Raises InputError when a worker dies.
    """
    if workers == 1 or count < 2:
        photographer = Photographer(shot)
        for index in range(count):
            yield photographer.take(index)
        return
    # Processes, since ray casting holds the interpreter's lock; spawned, since it has threads.
    context = multiprocessing.get_context("spawn")
    crew = []
    try:
        for number in range(workers):
            ours, theirs = context.Pipe(duplex=False)
            share = range(number, count, workers)
            worker = context.Process(target=_work, args=(shot, share, theirs), daemon=True)
            worker.start()
            theirs.close()
            crew.append((worker, ours))
        for index in range(count):
            yield _receive(crew[index % workers][1], index)
    finally:
        for worker, ours in crew:
            worker.terminate()
            worker.join()
            ours.close()


def _receive(connection: Connection, index: int) -> Frame:
    try:
        frame = connection.recv()
    except EOFError:
        raise InputError(f"two_rooms: a rendering process ended at frame {index}") from None
    if isinstance(frame, Exception):
        raise frame
    assert isinstance(frame, Frame)
    return frame


def _work(shot: Shot, share: Sequence[int], connection: Connection) -> None:
    """Render a share of the frames; the parent ends this process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    try:
        photographer = Photographer(shot)
        for index in share:
            connection.send(photographer.take(index))
    except BrokenPipeError:
        return
    except Exception as err:
        connection.send(err)
