"""Synchronisation of streams: one set of samples per message of the primary sensor."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.types import se3
from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform

_PATIENCE_S = 1.0  # longest wait of a message for a stream that is behind
_LATE_NS = 250_000_000  # longest delay of depth that is waited for: later poses steer no robot
_DELAYS = 30  # depth images whose delays count: of a second
_REACH_NS = 1_000_000_000  # older samples are not used; nor is one so far ahead of the next
_ODOMETRY_GAP_NS = 1_000_000_000  # longest gap for interpolation of odometry
_ODOMETRY_HOLD_NS = 100_000_000  # validity before the first and after the last odometry
_MOST_HELD = 4096  # queued samples per stream


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """A message's stamp and value."""

    stamp_ns: int  # on the sensor's clock
    arrived_ns: int  # on the clock of the recording, or of this machine: one for all sensors
    value: Any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SynchronisedSamples:
    """A message of the primary sensor with the measurements of all other sensors."""

    primary: Sample
    depth: Sample | None = None  # nearest in time
    scan: Sample | None = None  # the last since the previous set
    points: Sample | None = None  # the last since the previous set
    T_odom_base: Transform | None = None  # interpolated
    samples: Mapping[Sensor, Sequence[Sample]] = field(
        default_factory=dict
    )  # since the previous set


class Synchroniser:
    """Takes samples in the order of recording; gives sets in the order of the primary's.

    A set waits for the streams in `waits_for` (None: all) until any sample has arrived `patience_s`
    later, for depth until so long after it is due, as encoded depth comes later than its image.
    Stamps do not measure this wait: one sensor's clock can be ahead of the others'. A queued sample
    that is ahead of the next one of its stream is dropped, and counted in `faults`.
    """

    def __init__(
        self,
        primary: Sensor,
        streams: frozenset[Sensor],
        sync_tolerance_s: float,
        *,
        waits_for: frozenset[Sensor] | None = None,
        patience_s: float = _PATIENCE_S,
        extrapolates: bool = False,  # odometry that is late
        faults: FaultLog | None = None,
    ) -> None:
        self._faults = faults or FaultLog()
        self._primary = primary
        self._extrapolates = extrapolates
        self._waits_for = streams if waits_for is None else waits_for
        self._patience_ns = round(patience_s * 1e9)
        self._tolerance_ns = round(sync_tolerance_s * 1e9)
        self._waiting: deque[Sample] = deque()
        self._held: dict[Sensor, deque[Sample]] = {
            sensor: deque(maxlen=_MOST_HELD) for sensor in streams - {primary}
        }
        self._leapt: set[Sensor] = set()  # streams whose newest sample is far after the one before
        self._behind: set[Sensor] = set()  # those whose newest one was far before, and left out
        self._seen_ns: dict[Sensor, int] = {}  # the stamp of each stream's newest sample
        self._arrived_ns = 0  # the latest arrival
        self._delays_ns: deque[int] = deque(maxlen=_DELAYS)  # of depth, from stamp to arrival
        self._taken_ns: dict[Sensor, int] = {}  # the newest sample used in a set
        self._given_ns = -(2**63)  # the stamp of the last set
        self._passed: Sample | None = None  # the odometry before the oldest queued one

    def add(self, sensor: Sensor, sample: Sample) -> Iterator[SynchronisedSamples]:
        """Add a sample; yield the sets that are complete now."""
        queue = self._waiting if sensor is self._primary else self._held[sensor]
        before_ns = self._seen_ns.get(sensor)
        is_behind = before_ns is not None and before_ns > sample.stamp_ns + _REACH_NS
        if is_behind and sensor not in self._leapt | self._behind:
            self._behind.add(sensor)  # if the next one is, too, the clock was set back
            self._leave_out(sensor, sample, "behind the one before")
            return
        self._behind.discard(sensor)
        while queue and queue[-1].stamp_ns > sample.stamp_ns + _REACH_NS:
            self._leave_out(sensor, queue.pop(), "ahead of the next one")
        queue.append(sample)
        if before_ns is None or sample.stamp_ns > before_ns + _REACH_NS:
            self._leapt.add(sensor)
        else:
            self._leapt.discard(sensor)
        self._seen_ns[sensor] = sample.stamp_ns
        self._arrived_ns = max(self._arrived_ns, sample.arrived_ns)
        if sensor is Sensor.DEPTH:
            self._delays_ns.append(sample.arrived_ns - sample.stamp_ns)
        while self._waiting and self._is_complete(self._waiting[0]):
            yield self._bundle(self._waiting.popleft())

    def follow(self, primary: Sensor, waits_for: frozenset[Sensor]) -> None:
        """Use another primary sensor from now on; its queued samples become primary."""
        self._waits_for = waits_for
        if primary is not self._primary:
            self._held[self._primary] = deque(maxlen=_MOST_HELD)
            self._held.pop(primary, None)
            self._primary = primary
            self._waiting.clear()

    def hand_over(self, primary: Sensor, until_ns: int) -> Iterator[SynchronisedSamples]:
        """Use another primary sensor from now on; yield the waiting sets before `until_ns`.

        Queued samples of the new primary sensor become primary, those of the old one are queued.
        """
        while self._waiting and self._waiting[0].stamp_ns < until_ns:
            yield self._bundle(self._waiting.popleft())
        queued = self._held.pop(primary)
        self._held[self._primary] = deque(self._waiting, maxlen=_MOST_HELD)
        self._primary = primary
        self._waiting = deque(one for one in queued if one.stamp_ns > self._given_ns)

    def flush(self) -> Iterator[SynchronisedSamples]:
        """Yield the remaining sets at the end of the recording."""
        while self._waiting:
            yield self._bundle(self._waiting.popleft())

    def _leave_out(self, sensor: Sensor, sample: Sample, where: str) -> None:
        fault = f"{sensor.value} left out, its stamp is {where}"
        self._faults.add(fault, at_stamp(sample.stamp_ns))

    def _is_complete(self, primary: Sample) -> bool:
        """Tell whether no stream can still have a sample for the primary one's stamp."""
        stamp_ns = primary.stamp_ns
        for sensor, held in self._held.items():
            if sensor not in self._waits_for or self._is_overdue(sensor, primary):
                continue
            needed_ns = stamp_ns
            if sensor is Sensor.DEPTH and not any(one.stamp_ns == stamp_ns for one in held):
                needed_ns += self._tolerance_ns
            if self._seen_ns.get(sensor, -1) < needed_ns:
                return False
        return True

    def _is_overdue(self, sensor: Sensor, primary: Sample) -> bool:
        """Tell whether a stream's sample for the primary one is not waited for any more."""
        due_ns = primary.arrived_ns
        if sensor is Sensor.DEPTH:
            late_ns = [primary.stamp_ns + one - primary.arrived_ns for one in self._delays_ns]
            due_ns += max((one for one in late_ns if 0 < one <= _LATE_NS), default=0)
        return self._arrived_ns - due_ns > self._patience_ns

    def _bundle(self, primary: Sample) -> SynchronisedSamples:
        stamp_ns = self._given_ns = primary.stamp_ns
        return SynchronisedSamples(
            primary=primary,
            depth=self._nearest(Sensor.DEPTH, stamp_ns),
            scan=self._last_since(Sensor.SCAN, stamp_ns),
            points=self._last_since(Sensor.POINTS, stamp_ns),
            T_odom_base=self._odometry_at(stamp_ns),
            samples={
                sensor: self._take_until(sensor, stamp_ns)
                for sensor in self._held
                if sensor.is_sampled
            },
        )

    def _nearest(self, sensor: Sensor, stamp_ns: int) -> Sample | None:
        """Return the sample nearest to the stamp within the tolerance; each is used once."""
        held = self._held.get(sensor)
        while held and held[0].stamp_ns < stamp_ns - self._tolerance_ns:
            held.popleft()
        if not held:
            return None
        best = min(held, key=lambda sample: abs(sample.stamp_ns - stamp_ns))
        if abs(best.stamp_ns - stamp_ns) > self._tolerance_ns:
            return None
        held.remove(best)
        return best

    def _last_since(self, sensor: Sensor, stamp_ns: int) -> Sample | None:
        found = self._take_until(sensor, stamp_ns)
        return found[-1] if found else None

    def _take_until(self, sensor: Sensor, stamp_ns: int) -> Sequence[Sample]:
        """Return the unused samples up to the stamp, by stamp."""
        held = self._held.get(sensor)
        if not held:
            return ()
        found = [sample for sample in held if sample.stamp_ns <= stamp_ns]
        later = [sample for sample in held if sample.stamp_ns > stamp_ns]
        held.clear()
        held.extend(later)
        since_ns = self._taken_ns.get(sensor, stamp_ns - _REACH_NS)
        found = [sample for sample in found if sample.stamp_ns > since_ns]
        found.sort(key=lambda sample: sample.stamp_ns)
        if found:
            self._taken_ns[sensor] = found[-1].stamp_ns
        return found

    def _odometry_at(self, stamp_ns: int) -> Transform | None:
        held = self._held.get(Sensor.ODOMETRY)
        if not held:
            return None
        while len(held) > 1 and held[1].stamp_ns <= stamp_ns:
            self._passed = held.popleft()
        before, after = held[0], held[min(1, len(held) - 1)]
        if before.stamp_ns == stamp_ns or before is after or before.stamp_ns > stamp_ns:
            is_near = abs(before.stamp_ns - stamp_ns) <= _ODOMETRY_HOLD_NS
            if is_near and self._extrapolates and before.stamp_ns < stamp_ns:
                return self._extrapolated(before, stamp_ns)
            return np.array(before.value) if is_near else None
        gap_ns = after.stamp_ns - before.stamp_ns
        if gap_ns > _ODOMETRY_GAP_NS:
            return None
        ratio = (stamp_ns - before.stamp_ns) / gap_ns
        return se3.interpolate(before.value, after.value, ratio)

    def _extrapolated(self, last: Sample, stamp_ns: int) -> Transform:
        """Return T_odom_base (4, 4) [m] shortly after the last message, at constant velocity."""
        passed = self._passed
        gap_ns = 0 if passed is None else last.stamp_ns - passed.stamp_ns
        if passed is None or not 0 < gap_ns <= _ODOMETRY_GAP_NS:
            return np.array(last.value)
        return se3.interpolate(passed.value, last.value, (stamp_ns - passed.stamp_ns) / gap_ns)
