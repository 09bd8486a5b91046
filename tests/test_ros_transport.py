"""ROS 2 over DDS on this machine's loopback: bytes come as they were sent, late or not."""

from __future__ import annotations

import os
import socket
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import MagicMock, patch

import pytest

from sceneslam.ros.transport.transport import LOCALHOST, SUBNET, Network, Qos, open_transport
from sceneslam.types.errors import ConfigError

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install sceneslam[ros2]")
STRING = "std_msgs/msg/String"
WITHIN_S = 10.0
CDR = b"\x00\x01\x00\x00some"


def domain() -> int:
    """A domain that no other process of these tests is in: its ports are far from the others'."""
    return 100 + os.getpid() % 100


@contextmanager
def two_participants():
    first, second = (open_transport(Network(domain_id=domain())) for _ in range(2))
    try:
        yield first, second
    finally:
        first.close()
        second.close()


class Inbox:
    def __init__(self):
        self.arrivals, self._came = [], threading.Condition()

    def __call__(self, arrival):
        with self._came:
            self.arrivals.append(arrival)
            self._came.notify()

    def wait(self, count=1):
        with self._came:
            assert self._came.wait_for(lambda: len(self.arrivals) >= count, WITHIN_S)
        return self.arrivals


def until(condition):
    tick = threading.Event()
    for _ in range(int(WITHIN_S / 0.05)):
        if condition():
            return
        tick.wait(0.05)
    raise AssertionError("it did not come about")


@pytest.mark.parametrize("size", [8, 921_648])  # a word, a 640x480 image
def test_bytes_come_as_they_were_sent(size):
    cdr = b"\x00\x01\x00\x00" + bytes(range(256)) * (size // 256) + b"\x01" * (size % 256)
    with two_participants() as (sender, receiver):
        inbox = Inbox()
        receiver.subscribe("/camera", "sensor_msgs/msg/Image", inbox, Qos.RELIABLE)
        publisher = sender.publisher("/camera", "sensor_msgs/msg/Image", Qos.RELIABLE)
        until(
            lambda: (
                [(one.topic, one.msgtype) for one in receiver.publications()]
                == [("/camera", "sensor_msgs/msg/Image")]
            )
        )
        until(lambda: publisher.publish(cdr) or inbox.arrivals)
        assert inbox.arrivals[0].cdr == cdr and inbox.arrivals[0].topic == "/camera"


def test_who_comes_late_gets_the_last_of_what_is_latched():
    with two_participants() as (sender, receiver):
        publisher = sender.publisher("/map", STRING, Qos.LATCHED)
        for word in (b"old1", b"new1"):
            publisher.publish(b"\x00\x01\x00\x00" + word)
        inbox = Inbox()
        receiver.subscribe("/map", STRING, inbox, Qos.LATCHED)
        assert inbox.wait()[0].cdr.endswith(b"new1")


def test_own_topics_are_not_anothers():
    with two_participants() as (sender, receiver):
        sender.publisher("/scan", "sensor_msgs/msg/LaserScan")
        until(lambda: [one.topic for one in receiver.publications()] == ["/scan"])
        assert not sender.publications()


def test_topic_goes_with_who_published_it():
    with two_participants() as (sender, receiver):
        sender.publisher("/scan", STRING)
        until(lambda: receiver.publications())
        sender.close()
        until(lambda: not receiver.publications())


def test_callback_that_fails_is_logged_and_the_next_message_comes(caplog):
    with two_participants() as (sender, receiver):
        inbox = Inbox()

        def heard(arrival):
            inbox(arrival)
            raise ValueError("of no use")

        receiver.subscribe("/scan", STRING, heard, Qos.RELIABLE)
        publisher = sender.publisher("/scan", STRING)
        until(lambda: publisher.publish(CDR) or len(inbox.arrivals) > 1)
        assert "a message of /scan could not be processed: ValueError: of no use" in caplog.text


def test_samples_that_come_while_one_is_processed_are_kept():
    with two_participants() as (sender, receiver):
        inbox, is_free = Inbox(), threading.Event()

        def heard(arrival):
            inbox(arrival)
            is_free.wait(WITHIN_S)

        receiver.subscribe("/imu", STRING, heard, Qos.SAMPLES)
        publisher = sender.publisher("/imu", STRING)
        until(lambda: publisher.publish(CDR) or inbox.arrivals)
        before = len(inbox.arrivals)
        for _ in range(100):
            publisher.publish(CDR)
        is_free.set()
        inbox.wait(before + 100)


def test_nothing_is_left_of_a_transport_that_was_closed():
    before = threading.active_count()
    with two_participants() as (sender, receiver):
        receiver.subscribe("/scan", STRING, Inbox())
        publisher = sender.publisher("/scan", STRING)
    publisher.publish(CDR)  # to nobody
    sender.close()
    assert threading.active_count() == before


def test_every_socket_is_bound_to_the_loopback_interface():
    with two_participants():
        devices = set()
        for entry in Path("/proc/self/fd").iterdir():
            if entry.is_socket():
                with socket.socket(fileno=os.dup(int(entry.name))) as one:
                    if one.family == socket.AF_INET:
                        devices.add(one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16))
    assert devices == {b"lo\0"}


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ({"transport": "zenoh"}, "transport"),
        ({"domain_id": 500}, "domain_id"),
        ({"domain_id": True}, "domain_id"),
        ({"discovery": "world"}, "discovery"),
    ],
)
def test_impossible_networks_are_refused(words, key):
    with pytest.raises(ConfigError, match=key):
        Network(**words)


def test_environment_names_domain_and_range(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert Network().domain() == 17 and Network(domain_id=3).domain() == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(ConfigError, match="ROS_DOMAIN_ID"):
        Network().domain()
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    assert Network().reach() == LOCALHOST
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    assert Network().reach() == SUBNET and Network(discovery=LOCALHOST).reach() == LOCALHOST


@pytest.mark.parametrize(
    ("discovery", "before", "wanted"),
    [
        (None, None, "LOCALHOST"),
        (None, "SUBNET", "SUBNET"),
        (LOCALHOST, "SUBNET", "LOCALHOST"),
        (SUBNET, "LOCALHOST", "SUBNET"),
    ],
)
def test_rclpy_reads_the_range_of_its_run_alone(monkeypatch, discovery, before, wanted):
    """With a stand-in for rclpy: where it is installed, only its discovery would show the range."""
    name, found = "ROS_AUTOMATIC_DISCOVERY_RANGE", []
    monkeypatch.setenv(name, before or "")
    if before is None:
        monkeypatch.delenv(name)
    parts = ("rclpy", "rclpy.context", "rclpy.executors", "rclpy.node", "rclpy.qos")
    stand_in = {part: MagicMock() for part in parts}
    stand_in["rclpy"].init = lambda **_: found.append(os.environ.get(name))
    with patch.dict(sys.modules, stand_in):
        sys.modules.pop("sceneslam.ros.transport.rclpy_node", None)
        open_transport(Network(transport="rclpy", domain_id=0, discovery=discovery)).close()
    assert found == [wanted] and os.environ.get(name) == before
