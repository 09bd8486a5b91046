"""Live mode: the bus in its own thread, fed at the pace of the clock, newest observation first."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from time import monotonic_ns

from sceneslam.types.observation import Observation


class Mailbox:
    """Holds the newest observation; one that was not taken in time is dropped and counted."""

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: Observation | None = None
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, observation: Observation) -> None:
        """Leave an observation; a gyro's samples of one that it replaces are kept."""
        with self._changed:
            if self._waiting is not None:
                self.dropped += 1
                observation = observation.with_samples_of(self._waiting)
            self._waiting = observation
            self._changed.notify()

    def take(self) -> Observation | None:
        """Wait for an observation and return it, None when the mailbox is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._is_closed)
            observation, self._waiting = self._waiting, None
            return observation

    def close(self) -> None:
        """Let the taker finish what waits and end."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()


def run_live(observations: Iterator[Observation], step: Callable[[Observation], bool]) -> int:
    """Run `step` in its own thread on the observations as they come; return how many it missed.

    Recordings are paced by their stamps. `step` returns False to end the run. What it raises is
    raised here.
    """
    mailbox, errors, is_over = Mailbox(), [], threading.Event()

    def work() -> None:
        try:
            while (observation := mailbox.take()) is not None:
                if not step(observation):
                    break
        except BaseException as error:
            errors.append(error)
        finally:
            is_over.set()

    worker = threading.Thread(target=work, name="bus")
    worker.start()
    try:
        _deliver(observations, mailbox, is_over)
    finally:
        mailbox.close()
        worker.join()
    if errors:
        raise errors[0]
    return mailbox.dropped


def _deliver(
    observations: Iterator[Observation], mailbox: Mailbox, is_over: threading.Event
) -> None:
    """Put every observation into the mailbox when its time has come."""
    lag_ns: int | None = None  # clock - stamp of the first observation
    for observation in observations:
        if lag_ns is None:
            lag_ns = monotonic_ns() - observation.stamp_ns
        wait_s = (observation.stamp_ns + lag_ns - monotonic_ns()) / 1e9
        if is_over.wait(max(wait_s, 0.0)):
            return
        mailbox.put(observation)
