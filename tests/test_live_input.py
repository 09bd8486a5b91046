"""What live sources share: stamps of clocks that jump or are late, and an inbox of what is new."""

from time import monotonic_ns, time_ns

import pytest

from sceneslam.ros.transport.transport import Arrival
from sceneslam.sources.live.clock import StampClock, StampOrder
from sceneslam.sources.live.inbox import Inbox

MS, S = 1_000_000, 1_000_000_000


def lines(*messages, clock=None):
    clock = clock or StampClock()
    return [clock.line_up(topic, stamp, arrived) for topic, stamp, arrived in messages]


def test_steady_clock_is_left_alone():
    lined = lines(*[("/a", S + index * 33 * MS, index * 33 * MS) for index in range(9)])
    assert [one.stamp_ns for one in lined] == [S + index * 33 * MS for index in range(9)]
    assert {one.order for one in lined} == {StampOrder.RISING}


@pytest.mark.parametrize("jump_ns", [-100 * S, 3600 * S])
def test_jump_is_taken_out_of_all_topics_alike(jump_ns):
    lined = lines(
        ("/a", 10 * S, 0),
        ("/b", 10 * S, 1 * MS),
        ("/a", 10 * S + 33 * MS + jump_ns, 40 * MS),  # 7 ms late, as they come
        ("/b", 10 * S + 33 * MS + jump_ns, 34 * MS),
    )
    assert [one.order for one in lined[2:]] == [StampOrder.JUMPED, StampOrder.JUMPED]
    assert lined[2].stamp_ns == lined[3].stamp_ns  # what belongs together stays so
    assert lined[2].stamp_ns == pytest.approx(10 * S + 40 * MS)


def test_burst_after_a_stall_is_late_and_no_jump():
    lined = lines(
        ("/a", 1, 0), ("/a", 33 * MS, 5 * S), ("/a", 66 * MS, 5 * S), ("/a", 5 * S, 5 * S + 1)
    )
    assert [one.order for one in lined] == [
        StampOrder.RISING,
        StampOrder.LATE,
        StampOrder.LATE,
        StampOrder.RISING,
    ]
    assert all(one.shift_ns == 0 for one in lined)


def test_message_behind_the_one_before_is_unordered():
    lined = lines(("/a", 66 * MS, 0), ("/a", 33 * MS, 1), ("/a", 99 * MS, 33 * MS))
    assert [one.order for one in lined] == [
        StampOrder.RISING,
        StampOrder.UNORDERED,
        StampOrder.RISING,
    ]


def test_driver_that_restarts_with_another_clock_goes_on_from_where_it_was():
    lined = lines(("/a", 500 * S, 0), ("/a", 2 * S, 20 * S))
    assert lined[1].order is StampOrder.JUMPED and lined[1].stamp_ns == 520 * S


def test_clocks_that_drift_apart_are_not_late():
    clock = StampClock()
    for second in range(1, 20_000):  # the robot's is slow by 100 ppm: 2 s in the end
        lined = clock.line_up("/a", round(second * S * 0.9999), second * S)
    assert lined.order is StampOrder.RISING


def test_message_without_a_stamp_counts_as_measured_when_it_came():
    lined = lines(
        ("/a", 100 * S, 0),
        ("/b", 0, 5 * MS),
        ("/a", 100 * S + 33 * MS, 33 * MS),
        ("/b", 0, 40 * MS),
        ("/b", 0, 40 * MS),
    )
    measured_ns = [one.stamp_ns - 100 * S for one in lined]
    assert measured_ns == [0, 5 * MS, 33 * MS, 40 * MS, 40 * MS + 1]
    assert [one.order is StampOrder.UNSTAMPED for one in lined] == [
        False,
        True,
        False,
        True,
        True,
    ]


def test_robot_without_any_stamp_is_measured_by_this_machines_clock():
    clock = StampClock()
    arrived_ns = monotonic_ns()
    lined = clock.line_up("/a", 0, arrived_ns)
    assert abs(lined.stamp_ns - time_ns()) < S
    assert clock.measured_ns(lined.stamp_ns) == arrived_ns


def test_inbox_keeps_the_newest_of_each_topic():
    inbox = Inbox()
    for index in range(10):
        inbox.put(Arrival(topic="/image", cdr=bytes(1_000_000), arrived_ns=index))
    inbox.put(Arrival(topic="/imu", cdr=bytes(8), arrived_ns=10))
    assert [inbox.take(0.0).arrived_ns for _ in range(5)] == [6, 7, 8, 9, 10]
    assert inbox.take_dropped() == {"/image": 6} and not inbox.take_dropped()
    assert inbox.take(0.0) is None
    inbox.close()
    assert inbox.take(60.0) is None
