"""ROS 2 topics over Cyclone DDS, without a ROS installation.

ROS 2 maps topic `/a` to DDS topic `rt/a`, and type `pkg/msg/Name` to `pkg::msg::dds_::Name_`.
Messages are passed as bytes: every type is a placeholder with the right name. Participants match by
that name only, and an image is copied once. Fast DDS 3 (ROS 2 Kilted) also compares the types'
definitions; it matches if its profile sets `fastdds.type_propagation` to `disabled`.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic_ns
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.core import Qos as Policies
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from sceneslam.ros.transport.transport import (
    BEST_EFFORT,
    DEPTHS,
    LOCALHOST,
    Arrival,
    Heard,
    Network,
    Publication,
    Publisher,
    Qos,
)
from sceneslam.types.errors import ConfigError, text_of

_log = logging.getLogger(__name__)
_WAKE_S = 0.1  # interval at which `close` is noticed
_BATCH = 64  # messages read at once
_ENDPOINTS = 1000  # announcements read at once
_LATCHED = {
    Policy.Durability.TransientLocal,
    Policy.Durability.Transient,
    Policy.Durability.Persistent,
}
_CONFIG = "CYCLONEDDS_URI"
_environment = threading.Lock()  # a domain reads the environment when its first participant joins
# Discovery on this machine only: by the loopback interface, with multicast for participants with
# default settings (a robot's drivers), and by participant index for those without multicast.
_ON_LOOPBACK = (
    '<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>'
    "<AllowMulticast>spdp</AllowMulticast></General>"
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
)


class DdsTransport:
    """A participant of Cyclone DDS; a user's CYCLONEDDS_URI has priority over `discovery`."""

    def __init__(self, network: Network) -> None:
        domain = network.domain()
        try:
            with _configured(is_local=network.reach() == LOCALHOST):
                self._participant: Any = DomainParticipant(domain)
            self._announced = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        except DDSException as error:
            allowed = f"a domain that can be joined ({text_of(error)})"
            raise ConfigError("domain_id", domain, allowed) from error
        self._lock = threading.RLock()
        self._readers: dict[str, _Reader] = {}
        self._writers: dict[str, _Writer] = {}
        self._topics: dict[str, Any] = {}
        self._published: dict[Any, Publication] = {}  # by endpoint
        self._is_closed = False
        self._waitset = WaitSet(self._participant)
        self._thread: threading.Thread | None = None

    def publications(self) -> Sequence[Publication]:
        """Return the ROS publishers that other participants currently announce."""
        with self._lock:
            for endpoint in self._announced.take(_ENDPOINTS):
                name = endpoint.topic_name or ""  # a deleted writer has none
                if not _is_alive(endpoint):
                    self._published.pop(endpoint.key, None)
                elif name.startswith("rt/") and endpoint.key not in self._own_keys():
                    self._published[endpoint.key] = _publication(name[2:], endpoint)
            return tuple(self._published.values())

    def subscribe(self, topic: str, msgtype: str, heard: Heard, qos: Qos = Qos.SENSOR) -> None:
        """Call `heard` for each message of the topic, in the transport's thread."""
        with self._lock:
            reader = DataReader(self._participant, self._topic(topic, msgtype), _qos(qos))
            mask = SampleState.NotRead | ViewState.Any | InstanceState.Any
            condition = ReadCondition(reader, mask)
            self.unsubscribe(topic)
            self._readers[topic] = _Reader(reader=reader, condition=condition, heard=heard)
            self._waitset.attach(condition)
            if self._thread is None:
                self._thread = threading.Thread(target=self._listen, name="dds", daemon=True)
                self._thread.start()

    def unsubscribe(self, topic: str) -> None:
        """Delete the topic's reader."""
        with self._lock:
            one = self._readers.pop(topic, None)
            if one is not None:
                self._waitset.detach(one.condition)
                one.reader._delete(one.reader._ref)

    def publisher(self, topic: str, msgtype: str, qos: Qos = Qos.RELIABLE) -> Publisher:
        """Return the topic's writer."""
        with self._lock:
            if topic not in self._writers:
                named = self._topic(topic, msgtype)
                writer = DataWriter(self._participant, named, _qos(qos))
                self._writers[topic] = _Writer(writer, named.data_type)
            return self._writers[topic]

    def close(self) -> None:
        """Leave the domain."""
        self._is_closed = True
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        with self._lock:
            for writer in self._writers.values():
                writer.close()
            self._readers, self._writers, self._topics = {}, {}, {}
            if self._participant is not None:  # with its entities, which no destructor deletes
                self._participant._delete(self._participant._ref)
                self._participant = None

    def _listen(self) -> None:
        while not self._is_closed:
            self._waitset.wait(timeout=duration(seconds=_WAKE_S))
            with self._lock:
                taken = [
                    (one.heard, _arrival(topic, sample))
                    for topic, one in self._readers.items()
                    for sample in one.reader.take(_BATCH)
                    if isinstance(sample, _Bytes)
                ]
            for heard, arrival in taken:
                if not self._is_closed:
                    _deliver(heard, arrival)

    def _topic(self, topic: str, msgtype: str) -> Any:
        if topic not in self._topics:
            named = Topic(self._participant, f"rt{topic}", _named(_dds_type(msgtype)))
            self._topics[topic] = named
        return self._topics[topic]

    def _own_keys(self) -> set[Any]:
        return {writer.key for writer in self._writers.values()}


class _Bytes(IdlStruct):
    """A message as its serialised bytes."""

    def __init__(self, cdr: bytes) -> None:
        self.cdr = cdr

    def serialize(self, *_: Any, **__: Any) -> bytes:
        return self.cdr

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
        return cls(bytes(data))

    @classmethod
    def deserialize_key(cls, data: bytes, *_: Any, **__: Any) -> Any:
        return cls(b"")  # a deleted writer


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reader:
    """One subscription."""

    reader: Any
    condition: Any
    heard: Heard


class _Writer:
    """Publishes serialised messages of one type."""

    def __init__(self, writer: Any, data_type: Any) -> None:
        self._writer, self._data_type = writer, data_type
        self.key = writer.guid

    def publish(self, cdr: bytes) -> None:
        """Publish a message; no effect after `close`."""
        writer = self._writer
        if writer is not None:
            writer.write(self._data_type(cdr))

    def close(self) -> None:
        """Delete the writer."""
        self._writer = None


def _arrival(topic: str, sample: Any) -> Arrival:
    return Arrival(
        topic=topic,
        cdr=sample.cdr,
        arrived_ns=monotonic_ns(),
        publisher=sample.sample_info.publication_handle,
    )


def _deliver(heard: Heard, arrival: Arrival) -> None:
    try:
        heard(arrival)
    except Exception as error:
        _log.warning("a message of %s could not be processed: %s", arrival.topic, text_of(error))
        _log.debug("the whole error", exc_info=error)


@contextmanager
def _configured(*, is_local: bool) -> Iterator[None]:
    """Restrict a domain that is joined in this context to this machine, unless a URI is set."""
    with _environment:
        is_ours = is_local and not os.environ.get(_CONFIG)
        before = _sockets()
        if is_ours:
            os.environ[_CONFIG] = f"<CycloneDDS><Domain>{_ON_LOOPBACK}</Domain></CycloneDDS>"
        try:
            yield
        finally:
            if is_ours:
                del os.environ[_CONFIG]
        if is_ours:
            _keep_local(_sockets() - before)


def _sockets() -> set[int]:
    """Return the descriptors of this process's datagram sockets; empty without /proc."""
    found = set()
    for entry in Path("/proc/self/fd").glob("*"):
        try:
            if entry.is_socket():
                with socket.socket(fileno=os.dup(int(entry.name))) as one:
                    if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
                        found.add(int(entry.name))
        except OSError:  # closed in the meantime
            continue
    return found


def _keep_local(descriptors: set[int]) -> None:
    """Bind sockets to the loopback interface: the library listens on all addresses."""
    for descriptor in descriptors:
        try:
            with socket.socket(fileno=os.dup(descriptor)) as one:
                one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
        except OSError as error:
            _log.warning("DDS can be reached from other machines: %s", text_of(error))


def _named(typename: str) -> Any:
    """Return a type with that name whose samples are bytes."""
    return make_idl_struct(
        "Named", typename, {"placeholder": uint8}, bases=(_Bytes,), dataclassify=False
    )


def _qos(qos: Qos) -> Any:
    policies = [
        Policy.Reliability.BestEffort
        if qos in BEST_EFFORT
        else Policy.Reliability.Reliable(duration(milliseconds=100)),
        Policy.History.KeepLast(DEPTHS[qos]),
        Policy.Durability.TransientLocal
        if qos in (Qos.LATCHED, Qos.HISTORY)
        else Policy.Durability.Volatile,
    ]
    return Policies(*policies)


def _dds_type(msgtype: str) -> str:
    package, _, name = msgtype.replace("/msg/", "/").partition("/")
    return f"{package}::msg::dds_::{name}_"


def _ros_type(dds_type: str) -> str:
    return dds_type.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


def _publication(topic: str, endpoint: Any) -> Publication:
    policies = set(endpoint.qos or ())
    return Publication(
        topic=topic,
        msgtype=_ros_type(endpoint.type_name),
        is_reliable=Policy.Reliability.BestEffort not in policies,
        is_latched=bool(policies & _LATCHED),
    )


def _is_alive(endpoint: Any) -> bool:
    return bool(endpoint.sample_info.instance_state == InstanceState.Alive)
