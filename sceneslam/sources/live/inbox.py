"""Bounded queue between a driver's threads and the source's; the oldest entries are dropped."""

from __future__ import annotations

import threading
from collections import Counter, deque
from typing import Generic, Protocol, TypeVar

_MOST_BYTES = 4_000_000  # queued per topic: four colour images of 640x480
_MOST = 500  # messages queued per topic


class Item(Protocol):
    """An entry of an inbox."""

    @property
    def topic(self) -> str:
        """Return the name of its stream."""
        ...

    @property
    def size(self) -> int:
        """Return its size [bytes]."""
        ...


T = TypeVar("T", bound=Item)


class Inbox(Generic[T]):
    """A queue of measurements from any thread, read in order of arrival."""

    def __init__(self) -> None:
        self._dropped: Counter[str] = Counter()
        self._waiting: deque[T] = deque()
        self._bytes: Counter[str] = Counter()
        self._counts: Counter[str] = Counter()
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, item: T) -> None:
        """Add a message; drop the oldest of its topic if the topic's limit is exceeded."""
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
        """Return the oldest message, None after the timeout or if the inbox is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not self._waiting or self._is_closed:
                return None
            item = self._waiting.popleft()
            self._count(item, -1)
            return item

    @property
    def is_closed(self) -> bool:
        """Tell whether the inbox was closed."""
        return self._is_closed

    def take_dropped(self) -> Counter[str]:
        """Return how many messages of each topic were dropped since the last call."""
        with self._changed:
            dropped, self._dropped = self._dropped, Counter()
            return dropped

    def close(self) -> None:
        """Close the inbox; `take` returns None from then on."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _count(self, item: T, sign: int) -> None:
        self._counts[item.topic] += sign
        self._bytes[item.topic] += sign * item.size
