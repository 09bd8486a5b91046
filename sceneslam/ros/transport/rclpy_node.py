"""ROS 2 topics through rclpy, for any DDS vendor, if a ROS for this Python is installed."""

from __future__ import annotations

import importlib
import logging
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from time import monotonic_ns
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

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
_SPIN_S = 0.1
_RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_environment = threading.Lock()


class RclpyTransport:
    """The node `sceneslam`; messages are not deserialised (raw subscriptions)."""

    def __init__(self, network: Network) -> None:
        self._context = Context()
        with _discovering(network.discovery):
            rclpy.init(context=self._context, domain_id=network.domain())
            self._node = Node("sceneslam", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[str, _Publisher] = {}
        self._subscriptions: dict[str, Any] = {}
        self._is_closed = False
        self._thread = threading.Thread(target=self._spin, name="rclpy", daemon=True)
        self._thread.start()

    def publications(self) -> Sequence[Publication]:
        """Return the publishers of other nodes."""
        return tuple(
            Publication(
                topic=name,
                msgtype=one.topic_type,
                is_reliable=one.qos_profile.reliability is not ReliabilityPolicy.BEST_EFFORT,
                is_latched=one.qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL,
            )
            for name, _ in self._node.get_topic_names_and_types()
            for one in self._node.get_publishers_info_by_topic(name)
            if one.node_name != self._node.get_name()
        )

    def subscribe(self, topic: str, msgtype: str, heard: Heard, qos: Qos = Qos.SENSOR) -> None:
        """Call `heard` for each message of the topic, in the node's thread."""

        def deliver(cdr: bytes) -> None:
            if self._is_closed:
                return
            try:
                heard(Arrival(topic=topic, cdr=bytes(cdr), arrived_ns=monotonic_ns()))
            except Exception as error:
                _log.warning("a message of %s could not be processed: %s", topic, text_of(error))

        self.unsubscribe(topic)
        self._subscriptions[topic] = self._node.create_subscription(
            _type(msgtype), topic, deliver, _profile(qos), raw=True
        )
        self._executor.wake()

    def unsubscribe(self, topic: str) -> None:
        """Destroy the topic's subscription."""
        one = self._subscriptions.pop(topic, None)
        if one is not None:
            self._node.destroy_subscription(one)

    def publisher(self, topic: str, msgtype: str, qos: Qos = Qos.RELIABLE) -> Publisher:
        """Return the topic's publisher."""
        if topic not in self._publishers:
            made = self._node.create_publisher(_type(msgtype), topic, _profile(qos))
            self._publishers[topic] = _Publisher(made)
        return self._publishers[topic]

    def close(self) -> None:
        """Destroy the node."""
        if self._is_closed:
            return
        self._is_closed = True
        self._executor.wake()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        while not self._is_closed:
            self._executor.spin_once(timeout_sec=_SPIN_S)


@contextmanager
def _discovering(discovery: str | None) -> Iterator[None]:
    """Set the range that a context joined within reads from the environment, and only there."""
    with _environment:
        before = os.environ.get(_RANGE)
        os.environ[_RANGE] = (discovery or before or LOCALHOST).upper()
        try:
            yield
        finally:
            del os.environ[_RANGE]
            if before is not None:
                os.environ[_RANGE] = before


class _Publisher:
    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    def publish(self, cdr: bytes) -> None:
        """Publish a serialised message."""
        self._publisher.publish(cdr)


def _type(msgtype: str) -> Any:
    package, _, name = msgtype.replace("/msg/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        allowed = f"dds, or a ROS that has {msgtype} ({text_of(error)})"
        raise ConfigError("transport", "rclpy", allowed) from error


def _profile(qos: Qos) -> QoSProfile:
    is_kept = qos in (Qos.LATCHED, Qos.HISTORY)
    return QoSProfile(
        depth=DEPTHS[qos],
        reliability=ReliabilityPolicy.BEST_EFFORT
        if qos in BEST_EFFORT
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if is_kept else DurabilityPolicy.VOLATILE,
    )
