"""Messages between the network's thread and the source's: bounded, the newest win."""

from __future__ import annotations

import threading
from collections import Counter, deque

from sceneslam.ros.transport.transport import Arrival

_MOST_BYTES = 4_000_000  # of a topic that wait: four colour images of 640x480
_MOST = 500  # messages of a topic that wait


class Inbox:
    """Takes arrivals from any thread and gives them in order."""

    def __init__(self) -> None:
        self._dropped: Counter[str] = Counter()
        self._waiting: deque[Arrival] = deque()
        self._bytes: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, arrival: Arrival) -> None:
        """Leave a message; the oldest of its topic goes where too much of it waits."""
        topic, size = arrival.topic, len(arrival.cdr)
        with self._changed:
            while self._counts[topic] and (
                self._bytes[topic] + size > _MOST_BYTES or self._counts[topic] >= _MOST
            ):
                oldest = next(one for one in self._waiting if one.topic == topic)
                self._waiting.remove(oldest)
                self._count(oldest, -1)
                self._dropped[topic] += 1
            self._waiting.append(arrival)
            self._count(arrival, 1)
            self._changed.notify()

    def take(self, timeout_s: float) -> Arrival | None:
        """Return the oldest message, None when none came in time or the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not self._waiting or self._is_closed:
                return None
            arrival = self._waiting.popleft()
            self._count(arrival, -1)
            return arrival

    @property
    def is_closed(self) -> bool:
        """Tell whether nothing more is given."""
        return self._is_closed

    def take_dropped(self) -> Counter[str]:
        """Return how many messages of each topic were dropped since the last call."""
        with self._changed:
            dropped, self._dropped = self._dropped, Counter()
            return dropped

    def close(self) -> None:
        """Give nothing more."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _count(self, arrival: Arrival, sign: int) -> None:
        self._counts[arrival.topic] += sign
        self._bytes[arrival.topic] += sign * len(arrival.cdr)
