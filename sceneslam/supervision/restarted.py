"""What a SLAM module with a process of its own answers as `Restartable`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import monotonic
from typing import Protocol

from sceneslam.supervision.limits import Limits, Restarts


class Running(Protocol):
    """A process that may be answering its first request."""

    @property
    def is_alive(self) -> bool:
        """Tell whether it still runs."""
        ...

    def has_answer(self) -> bool:
        """Tell whether an answer can be read without a wait."""
        ...


class Restarted(ABC):
    """Starts its process again, at once or after a while, up to so many times."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._restarts = limits, Restarts(limits)
        self._is_active = False  # a session goes on in the process
        self._is_greeted = False  # it answered its first request

    @property
    def is_ready(self) -> bool:
        """Tell whether `activate` would not have to wait, and start a process where it may be."""
        self._bury()
        if self._restarts.wait_s(monotonic()) > 0:
            return False
        if self._running is None:
            self._start()
        return self._is_greeted or (self._running is not None and self._running.has_answer())

    @property
    def is_spent(self) -> bool:
        """Tell whether it failed too often to be started again, for now."""
        return self._restarts.is_spent(monotonic())

    def note_failure(self) -> None:
        """Take that a session failed: the next may begin after a while, longer each time."""
        if not self.is_spent:  # else it was refused for that, which is no failure
            self._restarts.note_failure(monotonic())

    @property
    @abstractmethod
    def _running(self) -> Running | None:
        """Return the process, None before the first start."""

    @abstractmethod
    def _start(self) -> None:
        """Start a process and send it its first request, without waiting."""

    @abstractmethod
    def _bury(self) -> None:
        """Notice a process that ended while nobody asked it for anything."""
