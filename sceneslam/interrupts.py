"""Handling of Ctrl-C, SIGTERM and SIGHUP: each ends a run; a second Ctrl-C also ends its saving."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequests:
    """Requests to stop a run: Ctrl-C, SIGTERM, and SIGHUP (a closed terminal).

    The first one raises KeyboardInterrupt, which ends the run, unless it is over already. From
    then on its results are saved: the next Ctrl-C calls `answer`, each after that raises
    KeyboardInterrupt. SIGTERM and SIGHUP change nothing there, since who sends them waits.
    """

    def __init__(self, answer: Callable[[], None]) -> None:
        self._answer = answer
        self._is_run_over = self._is_answered = False
        self.is_any = False

    def end_run(self) -> None:
        """Let no first request interrupt what follows."""
        self._is_run_over = True

    def handle(self, number: int, frame: object) -> None:
        """Handle a signal; called by the interpreter."""
        self.is_any = True
        if not self._is_run_over:
            self._is_run_over = True
            raise KeyboardInterrupt
        if number != signal.SIGINT:
            return
        if self._is_answered:
            raise KeyboardInterrupt
        self._is_answered = True
        self._answer()


@contextmanager
def stop_requests(answer: Callable[[], None]) -> Iterator[StopRequests]:
    """Handle all three signals as requests to stop.

    SIGINT is handled also if a shell's `&` ignores it; SIGHUP is not if `nohup` ignores it.
    """
    requests = StopRequests(answer)
    with _handler(requests.handle):
        yield requests


@contextmanager
def stop_raised() -> Iterator[None]:
    """Raise KeyboardInterrupt on all three signals, at the latest at the end.

    A library that is called within, or is being imported, may lose it or make another error of it.
    """
    requested: list[int] = []

    def handle(number: int, frame: object) -> None:
        requested.append(number)
        raise KeyboardInterrupt

    try:
        with _handler(handle):
            yield
    except KeyboardInterrupt:
        raise
    except BaseException:
        if requested:
            raise KeyboardInterrupt from None
        raise
    if requested:
        raise KeyboardInterrupt


@contextmanager
def termination_noted(note: Callable[[], None]) -> Iterator[None]:
    """Call `note` on Ctrl-C, SIGTERM and SIGHUP, and do nothing else."""

    def handle(number: int, frame: object) -> None:
        note()

    with _handler(handle):
        yield


def terminate_with(descriptor: int) -> None:
    """Send SIGTERM to this process when the other end of a pipe is closed, or its process ends."""

    def wait() -> None:
        while os.read(descriptor, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, name="parent", daemon=True).start()


@contextmanager
def _handler(handler: Any) -> Iterator[None]:
    """Set the handler of all three signals; only possible in the main thread."""
    with ExitStack() as stack:
        for number in _ENDING:
            is_nohup = number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN
            if is_nohup:
                continue
            try:
                previous = signal.signal(number, handler)
            except ValueError:
                break
            stack.callback(signal.signal, number, previous)
        yield
