"""The `Restartable` part of SLAM modules with a process of their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import monotonic
from typing import Generic, Protocol, TypeVar

from sceneslam.supervision.limits import Limits, Restarts


class Running(Protocol):
    """A process that may still be working on its first request."""

    @property
    def is_alive(self) -> bool:
        """Tell whether it is running."""
        ...

    def has_answer(self) -> bool:
        """Tell whether a reply can be read without waiting."""
        ...


P = TypeVar("P", bound=Running)


class Restarted(ABC, Generic[P]):
    """Restarts its process, with delays and up to a limit."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._restarts = limits, Restarts(limits)
        self._running: P | None = None  # None: not started yet, or ended
        self._is_active = False  # a session is running in the process
        self._is_greeted = False  # the first request has been answered

    @property
    def is_ready(self) -> bool:
        """Tell whether `activate` would not wait; start a process if that is allowed."""
        self._bury()
        if self._restarts.wait_s(monotonic()) > 0:
            return False
        if self._running is None:
            self._start()
        return self._is_greeted or (self._running is not None and self._running.has_answer())

    @property
    def is_spent(self) -> bool:
        """Tell whether there were too many failures for another restart now."""
        return self._restarts.is_spent(monotonic())

    def note_failure(self) -> None:
        """Record that a session failed; the delay before the next one grows."""
        if not self.is_spent:  # else the session was refused, which is not a failure
            self._restarts.note_failure(monotonic())

    @abstractmethod
    def _start(self) -> None:
        """Start a process and send it its first request, without waiting."""

    @abstractmethod
    def _bury(self) -> None:
        """Detect a process that ended while it was idle."""
