"""Ctrl-C, SIGTERM and SIGHUP: each ends a run, none spoils what is being saved."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Let SIGTERM, and SIGHUP (a closed terminal), end a run as Ctrl-C does.

    SIGINT also where a shell's `&` left it ignored; SIGHUP not where `nohup` did.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    with _handler(interrupt):
        yield


@contextmanager
def termination_noted(note: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP do no more than `note`."""

    def handle(number: int, frame: object) -> None:
        note()

    with _handler(handle):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Finish saving although one of them comes (again)."""
    with _handler(signal.SIG_IGN):
        yield


@contextmanager
def _handler(handler: Any) -> Iterator[None]:
    """Handle all of them so; where this is not the main thread, signals are not ours."""
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
