"""Measurements between a driver's threads and the source's: bounded, the newest win."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import Generic, Protocol, TypeVar

_MOST_BYTES = 4_000_000  # of a topic that wait: four colour images of 640x480
_MOST = 500  # messages of a topic that wait


class Item(Protocol):
    """What is put into an inbox."""

    @property
    def topic(self) -> str:
        """Return the stream that it belongs to."""
        ...

    @property
    def size(self) -> int:
        """Return its bytes."""
        ...


T = TypeVar("T", bound=Item)


class Inbox(Generic[T]):
    """Takes measurements from any thread and gives them in order."""

    def __init__(self) -> None:
        self._dropped: Counter[str] = Counter()
        self._waiting: deque[T] = deque()
        self._bytes: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, item: T) -> None:
        """Leave a message; the oldest of its topic goes where too much of it waits."""
        topic, size = item.topic, item.size
        with self._changed:
            while self._counts[topic] and (
                self._bytes[topic] + size > _MOST_BYTES or self._counts[topic] >= _MOST
            ):
                oldest = next(one for one in self._waiting if one.topic == topic)
                self._waiting.remove(oldest)
                self._count(oldest, -1)
                self._dropped[topic] += 1
            self._waiting.append(item)
            self._count(item, 1)
            self._changed.notify()

    def take(self, timeout_s: float) -> T | None:
        """Return the oldest message, None when none came in time or the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not self._waiting or self._is_closed:
                return None
            item = self._waiting.popleft()
            self._count(item, -1)
            return item

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

    def _count(self, item: T, sign: int) -> None:
        self._counts[item.topic] += sign
        self._bytes[item.topic] += sign * item.size
