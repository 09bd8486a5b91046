"""Messages received from a robot in the first seconds, as a recording in memory."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from time import monotonic
from typing import Any

from sceneslam.ros import names
from sceneslam.ros.messages import MessageDecoder, TopicType
from sceneslam.ros.transport.transport import Arrival, Publication, Qos, Transport
from sceneslam.sources.bag.frames import is_of_transforms, is_static
from sceneslam.sources.bag.recording import Message
from sceneslam.sources.bag.topics import TYPES

_LOOK_S = 0.1  # interval of topic discovery
_MOST_HELD = 400  # messages kept per topic ...
_MOST_PICTURES = 40  # ... and per topic with messages of about a megabyte
_PICTURES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/PointCloud2")
_TF_TYPE = "tf2_msgs/msg/TFMessage"
_NEEDS = ("image", "camera_info", "scan", "points", "odometry", "imu")


class LiveRecording:
    """A recording in memory of the messages that a transport receives.

    `topics` holds the received topics, `announced` also those without a message.
    """

    is_slow = False

    def __init__(self) -> None:
        self.topics: dict[str, TopicType] = {}
        self.announced: dict[str, str] = {}  # topic -> type
        self.other_types: dict[str, str] = {}  # topic -> what is published there too
        self.is_latched = True  # every /tf_static that is announced
        self.metadata: Mapping[str, Mapping[str, str]] = {}
        self.faults: Sequence[str] = ()
        self.skipped: Sequence[str] = ()
        self._held: dict[str, deque[Message]] = {}
        self._changed = threading.Lock()
        self._decoder = MessageDecoder(self.topics)

    def listen(
        self,
        transport: Transport,
        *,
        wanted: Collection[str],
        listen_s: float,
        wait_s: float,
        waits_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Receive until `listen_s` after the first measurement and until all `wanted` topics came.

        `waits_s` returns how long after the first measurement to wait for what is missing. Gives up
        after `wait_s`.
        """
        until_s, first_s = monotonic() + wait_s, None
        tick = threading.Event()
        while monotonic() < until_s:
            self._announce(transport)
            if first_s is None and not all(map(is_of_transforms, list(self.topics))):
                first_s = monotonic()
            listened_s = 0.0 if first_s is None else monotonic() - first_s
            is_all = listened_s >= listen_s and self.topics.keys() >= set(wanted)
            if is_all and listened_s >= waits_s():
                break
            tick.wait(_LOOK_S)
        for topic in self.announced:
            transport.unsubscribe(topic)

    def _announce(self, transport: Transport) -> None:
        """Subscribe to what may serve of what is announced by now."""
        publications = transport.publications()
        for one in publications:
            if not _may_serve(one.topic, one.msgtype):
                self.other_types[one.topic] = one.msgtype
            elif one.topic not in self.announced:
                self.announced[one.topic] = one.msgtype
                alike = [each for each in publications if each.topic == one.topic]
                transport.subscribe(one.topic, one.msgtype, self.take, self._qos(one.topic, alike))
            elif one.msgtype != self.announced[one.topic]:
                self.other_types[one.topic] = one.msgtype

    def _qos(self, topic: str, publications: Sequence[Publication]) -> Qos:
        """Return what all of a topic's publishers offer."""
        is_reliable = all(one.is_reliable for one in publications)
        if not is_of_transforms(topic) or not is_reliable:
            self.is_latched &= not is_static(topic)
            return Qos.SENSOR
        if not is_static(topic):
            return Qos.RELIABLE
        is_latched = any(one.is_latched for one in publications)
        self.is_latched &= is_latched
        return Qos.HISTORY if is_latched else Qos.RELIABLE

    def take(self, arrival: Arrival) -> None:
        """Add a message; beyond the limits, the oldest are dropped."""
        topic = arrival.topic
        with self._changed:
            msgtype = self.announced[topic]
            known = self.topics.get(topic)
            count = 1 if known is None else known.count + 1
            most = _MOST_PICTURES if msgtype in _PICTURES else _MOST_HELD
            held = self._held.setdefault(topic, deque(maxlen=most))
            held.append(Message(topic=topic, log_ns=arrival.arrived_ns, data=arrival.cdr))
            self.topics[topic] = TopicType.of_network(msgtype, count)

    def messages(self, topics: Collection[str], from_ns: int | None = None) -> Iterator[Message]:
        """Yield the messages by arrival."""
        found = [one for held in self._copies() for one in held if one.topic in topics]
        for message in sorted(found, key=lambda one: one.log_ns):
            if from_ns is None or message.log_ns >= from_ns:
                yield message

    def last(self, topic: str) -> Message | None:
        """Return the topic's last message."""
        held = self._held.get(topic)
        return held[-1] if held else None

    def forget(self) -> None:
        """Drop the messages; `topics` and `announced` stay."""
        with self._changed:
            self._held.clear()

    def decode(self, message: Message) -> Any:
        """Return the decoded message, None if its bytes are invalid."""
        return self._decoder.decode(message.topic, message.data)

    def _copies(self) -> list[list[Message]]:
        with self._changed:
            return [list(held) for held in self._held.values()]


def _may_serve(topic: str, msgtype: str) -> bool:
    if is_of_transforms(topic):
        return msgtype == _TF_TYPE
    is_own = topic.startswith(names.OWN_PREFIX)
    return not is_own and any(msgtype in TYPES[need] for need in _NEEDS)
