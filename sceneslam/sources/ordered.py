"""Any source, with its promises kept: stamps rise, arrays hold numbers, odometry is smooth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from numbers import Integral
from typing import Any

from sceneslam.interfaces import Source
from sceneslam.sources.clean import cleaned
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.sources.odometer import Odometer
from sceneslam.sources.wrapped import Wrapped
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.truth import GroundTruth

_STAMP_MAX_NS = 2**62  # 146 years: differences of two stamps fit into 64 bits
_PERIODS = 4  # one or two frames lost in a row are common


class Ordered(Wrapped):
    """Leaves out observations whose stamps repeat or run backwards, and values that are NaN.

    Odometry that was reset goes on from where it was.

    A single stamp ahead of its neighbours, by more than a few of the source's own periods, is left
    out too, rather than all that follow it. A gap longer than `max_gap_s` is reported.
    """

    def __init__(self, source: Source, max_gap_s: float = 5.0) -> None:
        if not max_gap_s > 0:
            raise ConfigError("max_gap_s", max_gap_s, "a number above 0 [s]")
        super().__init__(source)
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._log = FaultLog()

    @property
    def faults(self) -> Sequence[str]:
        """Return the source's faults and what was left out here."""
        return [*self._source.faults, *self._log.sentences()]

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations by rising stamp."""
        self._log.clear()
        self._odometer = Odometer()
        last_ns: int | None = None
        period_ns = self._max_gap_ns // _PERIODS  # the longest of late
        held: Observation | None = None  # after a jump: it may be the jump that is wrong
        for observation in filter(self._is_stamped, self._source):
            stamp_ns = observation.stamp_ns
            if held is not None:
                is_back = stamp_ns < held.stamp_ns
                if is_back and (last_ns is None or stamp_ns > last_ns):
                    self._skip(held)
                else:
                    self._note_gap(last_ns, held.stamp_ns)
                    last_ns = held.stamp_ns
                    yield self._mended(held)
                held = None
            if last_ns is not None and stamp_ns <= last_ns:
                self._skip(observation)
            elif last_ns is None or stamp_ns - last_ns > _PERIODS * period_ns:
                held = observation
            else:
                period_ns = max(stamp_ns - last_ns, period_ns // 2)
                last_ns = stamp_ns
                yield self._mended(observation)
        if held is not None:
            self._note_gap(last_ns, held.stamp_ns)
            yield self._mended(held)

    def ground_truth(self) -> GroundTruth | None:
        """Return the source's ground truth."""
        return self._source.ground_truth()

    def _mended(self, observation: Observation) -> Observation:
        return self._odometer.smooth(cleaned(observation, self._log), self._log)

    def _is_stamped(self, observation: object) -> bool:
        """Tell whether this is an observation with a stamp that a recording can hold."""
        stamp_ns: Any = observation.stamp_ns if isinstance(observation, Observation) else None
        if isinstance(stamp_ns, Integral) and abs(int(stamp_ns)) <= _STAMP_MAX_NS:
            return True
        self._log.add("observation left out, it has no stamp in nanoseconds", f"stamp {stamp_ns}")
        return False

    def _skip(self, observation: Observation) -> None:
        kind = "observation left out, its stamp repeats, runs backwards or jumps"
        self._log.add(kind, at_stamp(observation.stamp_ns))

    def _note_gap(self, last_ns: int | None, stamp_ns: int) -> None:
        if last_ns is not None and stamp_ns - last_ns > self._max_gap_ns:
            self._log.add(
                f"no observation for {(stamp_ns - last_ns) * 1e-9:.1f} s", at_stamp(last_ns)
            )
