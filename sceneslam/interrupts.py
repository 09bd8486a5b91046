"""Handling of Ctrl-C, SIGTERM and SIGHUP: each ends a run, and none interrupts saving."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Let SIGTERM, and SIGHUP (a closed terminal), end a run as Ctrl-C does.

    SIGINT is handled also if a shell's `&` ignores it; SIGHUP is not if `nohup` ignores it.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    with _handler(interrupt):
        yield


@contextmanager
def termination_noted(note: Callable[[], None]) -> Iterator[None]:
    """Call `note` on Ctrl-C, SIGTERM and SIGHUP, and do nothing else."""

    def handle(number: int, frame: object) -> None:
        note()

    with _handler(handle):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay all three signals until saving is finished."""
    with _handler(signal.SIG_IGN):
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
