"""Which of a topic's publishers is used, and what is told of it."""

import pytest

from sceneslam.sources.live.streams import Streams
from sceneslam.types.rig import Sensor

MS = 1_000_000
TOPIC = "/odom"
A, B = 1, 2


@pytest.fixture
def streams():
    return Streams({Sensor.ODOMETRY: TOPIC}, 1.0, 0)


def used(streams, messages):
    """Return the publishers of the messages (publisher, arrival [ms]) that are used."""
    return [
        publisher
        for publisher, arrived_ms in sorted(messages, key=lambda one: one[1])
        if streams.follows(TOPIC, publisher, arrived_ms * MS, 0)
    ]


def every(publisher, period_ms, from_ms, to_ms):
    return [(publisher, arrived_ms) for arrived_ms in range(from_ms, to_ms, period_ms)]


def told(streams):
    return [one["event"] for one in streams.notices()]


def test_change_of_the_used_publisher_is_told(streams):
    pausing = [*every(A, 33, 0, 400), *every(A, 33, 750, 2000)]
    found = used(streams, [*pausing, *every(B, 33, 10, 2000)])
    assert found == [A] * found.index(B) + [B] * (len(found) - found.index(B))
    assert told(streams) == ["second_publisher", "publisher_changed"]


@pytest.mark.parametrize("period_ms", [400, 1000, 2500])
def test_publishers_of_a_slow_topic_are_not_mixed(streams, period_ms):
    half_ms = period_ms // 2
    settled_ms = 3 * period_ms
    first = [*every(A, period_ms, 0, settled_ms), *every(B, period_ms, half_ms, settled_ms)]
    used(streams, first)
    later = [
        *every(A, period_ms, settled_ms, 20 * period_ms),
        *every(B, period_ms, settled_ms + half_ms, 20 * period_ms),
    ]
    assert len(set(used(streams, later))) == 1


def test_another_publisher_is_used_after_three_periods_of_silence(streams):
    messages = [*every(A, 500, 0, 2100), *every(B, 500, 2250, 9000)]
    assert used(streams, messages) == [A] * 5 + [B] * 11  # A is last heard at 2.0 s
    assert told(streams) == ["second_publisher", "publisher_changed"]


def test_publishers_that_take_turns_are_told_once_while_it_lasts(streams):
    turns = [(A if turn % 2 else B, 500 * turn + ms) for turn in range(20) for ms in (0, 33, 66)]
    used(streams, turns)
    assert told(streams) == ["publisher_changed"]


def test_two_publishers_that_messages_do_not_tell_apart_are_told_once(streams):
    used(streams, every(0, 33, 0, 200))
    for second in range(10):
        streams.count_publishers([TOPIC, TOPIC, "/scan"], 0, second * 1000 * MS)
    assert told(streams) == ["second_publisher"]


def test_announced_publishers_are_not_counted_where_messages_tell_them_apart(streams):
    used(streams, every(A, 33, 0, 200))
    streams.count_publishers([TOPIC, TOPIC], 0, 0)
    assert told(streams) == []
