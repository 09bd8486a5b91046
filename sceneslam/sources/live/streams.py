"""Monitoring of a robot's streams: which are alive, and events of each."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from statistics import median

from sceneslam.sources.bag.pace import StreamPace
from sceneslam.sources.live.clock import Lined, StampOrder
from sceneslam.types.rig import Sensor
from sceneslam.types.run import Event

_WAITED_FOR = frozenset({Sensor.DEPTH, Sensor.ODOMETRY, Sensor.GYRO, Sensor.ACCELEROMETER})
_STREAK_NS = 5_000_000_000  # a lasting condition is reported at this interval
_FOLLOWED_NS = 300_000_000  # a publisher that is silent for so long has left, ...
_FOLLOWED_PERIODS = 3  # ... and for so many of its periods
_UNKNOWN = 0  # the publisher, if the transport does not tell it
_ARRIVALS = 6  # from which a publisher's period is measured


class Streams:
    """Detects topics that fall silent, return or are late; `notices` is thread-safe."""

    def __init__(self, topics: Mapping[Sensor, str], silent_after_s: float, now_ns: int) -> None:
        self._topics = topics
        self._silent_ns = round(silent_after_s * 1e9)
        self._pace = StreamPace(topics, silent_after_s, now_ns)
        self._first_ns: dict[str, int] = {}
        self._told_ns: dict[tuple[str, str], int] = {}
        self._followed: dict[str, int] = {}  # topic -> used publisher
        self._arrivals_ns: dict[tuple[str, int], deque[int]] = {}  # of a topic and publisher
        self._shifts_ns: dict[str, int] = {}
        self._dropped: Counter[str] = Counter()
        self._dropped_ns = now_ns
        self._notices: list[Event] = []
        self._lock = threading.Lock()

    @property
    def pace(self) -> Sensor:
        """Return the sensor that sets the pace of observations: the first that is alive."""
        return self._pace.sensor

    @property
    def waits_for(self) -> frozenset[Sensor]:
        """Return the live streams whose measurement of the same instant is needed."""
        return frozenset(
            sensor
            for sensor, topic in self._topics.items()
            if sensor in _WAITED_FOR and not self._pace.is_silent(topic)
        )

    def has_begun(self, stamp_ns: int) -> bool:
        """Tell whether all live streams had a message by then; earlier observations are partial.

        Streams with their own rate, such as a laser's, need to have had one message at any time.
        """
        for sensor, topic in self._topics.items():
            first_ns = self._first_ns.get(topic)
            if first_ns is None:
                if not self._pace.is_silent(topic):
                    return False
            elif sensor in _WAITED_FOR and first_ns > stamp_ns:
                return False
        return True

    def follows(self, topic: str, publisher: int, arrived_ns: int, stamp_ns: int) -> bool:
        """Tell whether a message is from the topic's used publisher.

        With two publishers, the first is used until it is silent.
        """
        arrivals_ns = self._arrivals_ns.setdefault((topic, publisher), deque(maxlen=_ARRIVALS))
        arrivals_ns.append(arrived_ns)
        followed = self._followed.setdefault(topic, publisher)
        if publisher == followed:
            return True
        followed_ns = self._arrivals_ns[topic, followed]
        if arrived_ns - followed_ns[-1] < self._patience_ns(followed_ns):
            self.tell_once("second_publisher", stamp_ns, arrived_ns, topic=topic)
            return False
        self._followed[topic] = publisher
        self.tell_once("publisher_changed", stamp_ns, arrived_ns, topic=topic)
        return True

    def count_publishers(self, topics: Iterable[str], stamp_ns: int, now_ns: int) -> None:
        """Report two publishers of a topic whose messages do not say who sent them.

        `topics` has the topic of each publisher.
        """
        for topic, count in Counter(topics).items():
            if count > 1 and self._followed.get(topic) == _UNKNOWN:
                self.tell_once("second_publisher", stamp_ns, now_ns, topic=topic)

    def hear(self, topic: str, lined: Lined, arrived_ns: int) -> None:
        """Record the arrival of a message."""
        self._first_ns.setdefault(topic, lined.stamp_ns)
        if self._pace.hear(topic, arrived_ns):
            self.tell("stream_returned", lined.stamp_ns, topic=topic)
        if lined.order is StampOrder.JUMPED:
            before_ns = self._shifts_ns.get(topic, 0)
            jumped_s = (before_ns - lined.shift_ns) / 1e9
            self.tell(
                "clock_jump",
                lined.stamp_ns,
                topic=topic,
                jumped_s=jumped_s,
                shift_ns=lined.shift_ns,
                paces=topic == self._topics[self.pace],
            )
        elif lined.order is not StampOrder.RISING:
            self.tell_once(lined.order.name.lower(), lined.stamp_ns, arrived_ns, topic=topic)
        self._shifts_ns[topic] = lined.shift_ns

    def look(self, now_ns: int, stamp_ns: int) -> bool:
        """Detect silent streams; return whether there is a new one."""
        fallen = self._pace.look(now_ns)
        for topic in fallen:
            self.tell("stream_silent", stamp_ns, topic=topic, for_s=self._silent_ns / 1e9)
        return bool(fallen)

    def drop(self, counts: Mapping[str, int], now_ns: int, stamp_ns: int) -> None:
        """Record numbers of dropped messages; events report their sums."""
        self._dropped.update(counts)
        if self._dropped and now_ns - self._dropped_ns > _STREAK_NS:
            self._dropped_ns = now_ns
            for topic, count in sorted(self._dropped.items()):
                self.tell("messages_dropped", stamp_ns, topic=topic, count=count)
            self._dropped.clear()

    def _patience_ns(self, arrivals_ns: Sequence[int]) -> float:
        """Return how long a publisher has to be silent until another one is used."""
        if len(arrivals_ns) < 2:
            return max(_FOLLOWED_NS, self._silent_ns)
        period_ns = median(later - earlier for earlier, later in pairwise(arrivals_ns))
        return max(_FOLLOWED_NS, _FOLLOWED_PERIODS * period_ns)

    def notices(self) -> Sequence[Event]:
        """Return the events since the last call."""
        with self._lock:
            notices, self._notices = self._notices, []
            return notices

    def tell_once(self, event: str, stamp_ns: int, now_ns: int, **fields: object) -> None:
        """Report a condition of a topic once while it lasts."""
        key = (event, str(fields))
        last_ns = self._told_ns.get(key)
        self._told_ns[key] = now_ns
        if last_ns is None or now_ns - last_ns > _STREAK_NS:
            self.tell(event, stamp_ns, **fields)

    def tell(self, event: str, stamp_ns: int, **fields: object) -> None:
        """Add an event."""
        with self._lock:
            self._notices.append({"event": event, "stamp_ns": stamp_ns, **fields})
