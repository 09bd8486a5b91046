"""Ctrl-C and SIGTERM: both end a run, neither spoils what is being saved."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Let SIGTERM end a run as Ctrl-C does, and SIGINT also where a shell's `&` left it ignored."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    with _handler(signal.SIGTERM, interrupt), _handler(signal.SIGINT, interrupt):
        yield


@contextmanager
def termination_noted(note: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM do no more than `note`."""

    def handle(number: int, frame: object) -> None:
        note()

    with _handler(signal.SIGTERM, handle), _handler(signal.SIGINT, handle):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Finish saving although Ctrl-C is pressed again or SIGTERM comes."""
    with _handler(signal.SIGINT, signal.SIG_IGN), _handler(signal.SIGTERM, signal.SIG_IGN):
        yield


@contextmanager
def _handler(number: int, handler: Any) -> Iterator[None]:
    try:
        previous = signal.signal(number, handler)
    except ValueError:  # not the main thread: signals are not ours
        yield
        return
    try:
        yield
    finally:
        signal.signal(number, previous)
