"""Alignment of the stamps of a robot's topics to one monotonic time line, despite clock jumps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from time import monotonic_ns, time_ns

# Delays of drivers and networks are no clock jumps. A driver that queues more than a second of
# measurements is of no use to a moving robot.
_JUMP_NS = 1_000_000_000
_LATE_NS = 500_000_000  # delay relative to the fastest message
_DRIFT_RATIO = 5e-4  # largest drift between two clocks: crystals are ten times better
_SAME_CLOCK_NS = 1_000_000_000  # clocks that differ by less are taken for the same clock


class StampOrder(Enum):
    """How a message's stamp relates to the previous ones."""

    RISING = "rising"
    UNORDERED = "its stamp is before that of the message before"
    LATE = "it came late"
    JUMPED = "the clock jumped"
    UNSTAMPED = "it has no stamp; its arrival is used"


@dataclass(slots=True, kw_only=True)
class _Stream:
    stamp_ns: int  # of the last message, unchanged
    arrived_ns: int
    shift_ns: int  # offset added to its stamps


@dataclass(frozen=True, slots=True, kw_only=True)
class Lined:
    """A stamp aligned to the time line."""

    stamp_ns: int
    order: StampOrder
    shift_ns: int  # offset that was added


class StampClock:
    """Aligns stamps by the arrival times of their messages.

    A clock jumped if a stamp is a second ahead of its expected time, or before the previous stamp
    of its topic. From then on the stream continues without a gap, and other streams that jump with
    it are shifted by the same offset, so that simultaneous measurements stay simultaneous.
    """

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}
        self._delay_ns: int | None = None  # smallest arrival - stamp
        self._noted_ns = 0  # last update of the delay
        self._real_ns = monotonic_ns() - time_ns()  # this machine's monotonic - real time

    def line_up(self, topic: str, stamp_ns: int, arrived_ns: int) -> Lined:
        """Return the stamp of a topic's newest message on the time line."""
        if stamp_ns == 0:
            return self._stamped(topic, arrived_ns)
        stream = self._streams.get(topic)
        order = StampOrder.RISING
        if stream is None:
            stream = self._begin(stamp_ns, arrived_ns)
            self._streams[topic] = stream
        elif self._has_jumped(stream, stamp_ns, arrived_ns):
            order = StampOrder.JUMPED
            stream.shift_ns = self._shift(stream, stamp_ns, arrived_ns - stream.arrived_ns)
        elif stamp_ns <= stream.stamp_ns:
            order = StampOrder.UNORDERED
        lined_ns = stamp_ns + stream.shift_ns
        is_late = self._note_delay(arrived_ns - lined_ns, arrived_ns)
        if order is StampOrder.RISING and is_late:
            order = StampOrder.LATE
        if order is not StampOrder.UNORDERED:
            stream.stamp_ns, stream.arrived_ns = stamp_ns, arrived_ns
        return Lined(stamp_ns=lined_ns, order=order, shift_ns=stream.shift_ns)

    def _stamped(self, topic: str, arrived_ns: int) -> Lined:
        """Return a stamp for a message without one: its arrival minus the shortest delay."""
        if self._delay_ns is None:
            self._delay_ns, self._noted_ns = self._real_ns, arrived_ns
        stamp_ns, last = arrived_ns - self._delay_ns, self._streams.get(topic)
        if last is not None:
            stamp_ns = max(stamp_ns, last.stamp_ns + last.shift_ns + 1)
        self._streams[topic] = _Stream(stamp_ns=stamp_ns, arrived_ns=arrived_ns, shift_ns=0)
        return Lined(stamp_ns=stamp_ns, order=StampOrder.UNSTAMPED, shift_ns=0)

    def measured_ns(self, stamp_ns: int) -> int:
        """Return the time [ns] of an aligned stamp on this machine's monotonic clock.

        Real time is used if the robot's clock is this machine's; else the fastest message so far is
        assumed to have had no delay.
        """
        delay_ns = self._delay_ns or 0
        is_same = 0 <= delay_ns - self._real_ns < _SAME_CLOCK_NS
        return stamp_ns + (self._real_ns if is_same else delay_ns)

    def _has_jumped(self, stream: _Stream, stamp_ns: int, arrived_ns: int) -> bool:
        if stamp_ns < stream.stamp_ns - _JUMP_NS:
            return True
        early_ns = (self._delay_ns or 0) - (arrived_ns - stamp_ns - stream.shift_ns)
        return early_ns > _JUMP_NS

    def _note_delay(self, delay_ns: int, arrived_ns: int) -> bool:
        """Update the smallest delay by a message's; return whether the message is late."""
        if self._delay_ns is None:
            self._delay_ns, self._noted_ns = delay_ns, arrived_ns
        drift_ns = round((arrived_ns - self._noted_ns) * _DRIFT_RATIO)
        self._delay_ns, self._noted_ns = min(self._delay_ns + drift_ns, delay_ns), arrived_ns
        return delay_ns - self._delay_ns > _LATE_NS

    def _begin(self, stamp_ns: int, arrived_ns: int) -> _Stream:
        """Return a new stream, with another stream's offset if its stamps need one."""
        shift_ns = 0
        if self._delay_ns is not None:
            now_ns = arrived_ns - self._delay_ns
            shift_ns = self._nearest_shift(stamp_ns, now_ns, default_ns=0)
        return _Stream(stamp_ns=stamp_ns, arrived_ns=arrived_ns, shift_ns=shift_ns)

    def _shift(self, stream: _Stream, stamp_ns: int, passed_ns: int) -> int:
        """Return the offset that lets a stream continue after a jump."""
        due_ns = stream.stamp_ns + stream.shift_ns + passed_ns
        return self._nearest_shift(stamp_ns, due_ns, default_ns=due_ns - stamp_ns)

    def _nearest_shift(self, stamp_ns: int, due_ns: int, *, default_ns: int) -> int:
        """Return the other streams' offset that brings a stamp to its due time, or the default."""
        shifts = [0, *(stream.shift_ns for stream in self._streams.values())]
        best_ns = min(shifts, key=lambda shift_ns: abs(stamp_ns + shift_ns - due_ns))
        return best_ns if abs(stamp_ns + best_ns - due_ns) <= _JUMP_NS else default_ns
