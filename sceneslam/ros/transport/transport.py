"""The interface of ROS 2 transports, and their factory."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from sceneslam.types.errors import ConfigError, text_of

DDS, RCLPY = "dds", "rclpy"
LOCALHOST, SUBNET = "localhost", "subnet"
_DOMAIN_MAX = 232  # largest id for which DDS has port numbers


class Qos(Enum):
    """Quality of service profiles, named as in ROS 2."""

    SENSOR = "sensor data: best effort, the last few"
    SAMPLES = "the same of an IMU or of odometry: the last second or more"
    RELIABLE = "reliable, the last ten"
    LATCHED = "reliable and transient local: who comes later gets the last one"
    HISTORY = "reliable and transient local, a hundred: as /tf_static is sent by several"


DEPTHS = {  # messages kept
    Qos.SENSOR: 5,
    Qos.SAMPLES: 500,
    Qos.RELIABLE: 10,
    Qos.LATCHED: 1,
    Qos.HISTORY: 100,
}
BEST_EFFORT = (Qos.SENSOR, Qos.SAMPLES)


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """A received message."""

    topic: str
    cdr: bytes  # with its header of four bytes
    arrived_ns: int  # CLOCK_MONOTONIC
    publisher: int = 0  # who sent it, where the transport tells

    @property
    def size(self) -> int:
        """Return the message's size [bytes]."""
        return len(self.cdr)


Heard = Callable[[Arrival], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Publication:
    """A publisher of another participant, as announced."""

    topic: str
    msgtype: str
    is_reliable: bool = True
    is_latched: bool = False  # transient local


class Publisher(Protocol):
    """Sends messages on one topic."""

    def publish(self, cdr: bytes) -> None:
        """Send a serialised message; returns at once."""
        ...


class Transport(Protocol):
    """A participant of a ROS 2 domain. All methods may be called from any thread.

    Topics are named as in ROS (`/scan`), types as `sensor_msgs/msg/LaserScan`. An exception of a
    callback is logged, and the next message is delivered.
    """

    def publications(self) -> Sequence[Publication]:
        """Return the known publishers of other participants."""
        ...

    def subscribe(self, topic: str, msgtype: str, heard: Heard, qos: Qos = Qos.SENSOR) -> None:
        """Call `heard` for every message from now on, in the transport's thread."""
        ...

    def unsubscribe(self, topic: str) -> None:
        """End the subscription of a topic, if there is one."""
        ...

    def publisher(self, topic: str, msgtype: str, qos: Qos = Qos.RELIABLE) -> Publisher:
        """Return the publisher of a topic; the same one for the same topic."""
        ...

    def close(self) -> None:
        """Leave the domain; no callback is called afterwards. May be called twice."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Network:
    """Domain and discovery range."""

    transport: str = DDS
    domain_id: int | None = None  # None: ROS_DOMAIN_ID, else 0
    discovery: str | None = None  # None: ROS_AUTOMATIC_DISCOVERY_RANGE, else localhost

    def __post_init__(self) -> None:
        if self.transport not in (DDS, RCLPY):
            raise ConfigError("transport", self.transport, f"{DDS} or {RCLPY}")
        if self.domain_id is not None and not _is_domain(self.domain_id):
            raise ConfigError("domain_id", self.domain_id, f"null or 0 to {_DOMAIN_MAX}")
        if self.discovery not in (None, LOCALHOST, SUBNET):
            raise ConfigError("discovery", self.discovery, f"null, {LOCALHOST} or {SUBNET}")

    def domain(self) -> int:
        """Return the domain id; raises ConfigError if ROS_DOMAIN_ID is invalid."""
        if self.domain_id is not None:
            return self.domain_id
        text = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not text.isdecimal() or not _is_domain(int(text)):
            raise ConfigError("ROS_DOMAIN_ID", text, f"0 to {_DOMAIN_MAX}")
        return int(text)

    def reach(self) -> str:
        """Return the discovery range, `localhost` (the default) or `subnet`."""
        if self.discovery is not None:
            return self.discovery
        text = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", LOCALHOST).lower()
        return SUBNET if text == SUBNET else LOCALHOST


def open_transport(network: Network) -> Transport:
    """Join the domain.

    Raises ConfigError if the library is missing or the domain cannot be joined.
    """
    try:
        if network.transport == RCLPY:
            from sceneslam.ros.transport.rclpy_node import RclpyTransport

            return RclpyTransport(network)
        from sceneslam.ros.transport.dds import DdsTransport

        return DdsTransport(network)
    except ImportError as error:
        installs = "pip install 'sceneslam[ros2]' for dds; a ROS of this Python for rclpy"
        allowed = f"{DDS} | {RCLPY}, installed ({text_of(error)}; {installs})"
        raise ConfigError("transport", network.transport, allowed) from error


def _is_domain(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _DOMAIN_MAX
