"""The stamps of a robot's topics on one time line that rises, whatever its clocks do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from time import monotonic_ns, time_ns

# What is no jump: what drivers and networks hold up. A driver that queues more than a second of
# measurements is of no use to a robot that moves.
_JUMP_NS = 1_000_000_000
_LATE_NS = 500_000_000  # behind the fastest message
_DRIFT_RATIO = 5e-4  # by which two clocks may run apart: crystals are ten times better
_SAME_CLOCK_NS = 1_000_000_000  # a robot's clock so near to this machine's is this machine's


class StampOrder(Enum):
    """How a message's stamp goes with those before it."""

    RISING = "rising"
    UNORDERED = "its stamp is before that of the message before"
    LATE = "it came late"
    JUMPED = "the clock jumped"


@dataclass(slots=True, kw_only=True)
class _Stream:
    stamp_ns: int  # of the last message, as it came
    arrived_ns: int
    shift_ns: int  # what is added to its stamps


@dataclass(frozen=True, slots=True, kw_only=True)
class Lined:
    """A stamp on the time line."""

    stamp_ns: int
    order: StampOrder
    shift_ns: int  # what was added to it


class StampClock:
    """Lines stamps up by when messages arrive.

    A clock jumped where a stamp is a second ahead of its time, or behind that of the message before
    it. From there on the stream goes on from where it was, and other streams that jump with it are
    shifted by the same, so that what belongs together stays so.
    """

    def __init__(self) -> None:
        self._streams: dict[str, _Stream] = {}
        self._delay_ns: int | None = None  # arrival - stamp of the fastest message
        self._noted_ns = 0  # when that was looked at last
        self._real_ns = monotonic_ns() - time_ns()  # of this machine: monotonic - real time

    def line_up(self, topic: str, stamp_ns: int, arrived_ns: int) -> Lined:
        """Return the stamp of a topic's newest message on the time line."""
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

    def measured_ns(self, stamp_ns: int) -> int:
        """Return when a stamp of the time line was, by this machine's monotonic clock.

        By real time where the robot's clock is this machine's, else as if the fastest message so
        far had come at once.
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
        """Take how long a message was under way; return whether that is late."""
        if self._delay_ns is None:
            self._delay_ns, self._noted_ns = delay_ns, arrived_ns
        drift_ns = round((arrived_ns - self._noted_ns) * _DRIFT_RATIO)
        self._delay_ns, self._noted_ns = min(self._delay_ns + drift_ns, delay_ns), arrived_ns
        return delay_ns - self._delay_ns > _LATE_NS

    def _begin(self, stamp_ns: int, arrived_ns: int) -> _Stream:
        """Return a stream that begins; on another's shift where its stamps fit only so."""
        shift_ns = 0
        if self._delay_ns is not None:
            now_ns = arrived_ns - self._delay_ns
            shift_ns = self._nearest_shift(stamp_ns, now_ns, default_ns=0)
        return _Stream(stamp_ns=stamp_ns, arrived_ns=arrived_ns, shift_ns=shift_ns)

    def _shift(self, stream: _Stream, stamp_ns: int, passed_ns: int) -> int:
        """Return what brings a stream that jumped back to where it would be."""
        due_ns = stream.stamp_ns + stream.shift_ns + passed_ns
        return self._nearest_shift(stamp_ns, due_ns, default_ns=due_ns - stamp_ns)

    def _nearest_shift(self, stamp_ns: int, due_ns: int, *, default_ns: int) -> int:
        """Return the shift in use that brings a stamp to where it is due, or the default."""
        shifts = [0, *(stream.shift_ns for stream in self._streams.values())]
        best_ns = min(shifts, key=lambda shift_ns: abs(stamp_ns + shift_ns - due_ns))
        return best_ns if abs(stamp_ns + best_ns - due_ns) <= _JUMP_NS else default_ns
