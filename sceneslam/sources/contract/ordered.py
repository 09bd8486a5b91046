"""A wrapper that ensures a source's contract: rising stamps, finite arrays, smooth odometry."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from numbers import Integral
from typing import Any

from sceneslam.interfaces import Source
from sceneslam.sources.changes.wrapped import Wrapped
from sceneslam.sources.contract.clean import cleaned
from sceneslam.sources.contract.odometer import Odometer
from sceneslam.sources.contract.rests import Rests
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.trajectory import STAMP_MAX_NS

_LOG = logging.getLogger(__name__)
_PERIODS = 4  # one or two frames lost in a row are common


class Ordered(Wrapped):
    """Leaves out observations whose stamps repeat or run backwards, and invalid values.

    Odometry that was reset continues from its last pose.

    A single stamp that is ahead of its neighbours by more than a few periods is left out too,
    rather than all that follow it. A gap longer than `max_gap_s` is a fault, unless the robot
    rested: over the gap, odometry moved no farther than between two other observations of the run.
    """

    def __init__(self, source: Source, max_gap_s: float = 5.0) -> None:
        if not max_gap_s > 0:
            raise ConfigError("max_gap_s", max_gap_s, "a number above 0 [s]")
        super().__init__(source)
        self._max_gap_ns = round(max_gap_s * 1e9)
        self._log = FaultLog()
        self._rests = Rests(self._max_gap_ns)

    @property
    def faults(self) -> Sequence[str]:
        """Return the source's faults and counts of what was left out here."""
        gaps = FaultLog()
        for gap in self._rests.losses:
            gaps.add(f"no observation for {gap.duration_s:.1f} s", at_stamp(gap.start_ns))
        return [*self._source.faults, *self._log.sentences(), *gaps.sentences()]

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations by rising stamp."""
        self._log.clear()
        self._odometer, self._rests = Odometer(), Rests(self._max_gap_ns)
        self._camera = self._source.rig.camera
        last_ns: int | None = None
        period_ns = self._max_gap_ns // _PERIODS  # the longest recent period
        held: Observation | None = None  # after a jump ahead, until the next stamp confirms it
        for observation in filter(self._is_stamped, self._source):
            stamp_ns = observation.stamp_ns
            if held is not None:
                is_back = stamp_ns < held.stamp_ns
                if is_back and (last_ns is None or stamp_ns > last_ns):
                    self._skip(held)
                else:
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
            yield self._mended(held)
        self._tell_of_rests()

    def _mended(self, observation: Observation) -> Observation:
        finite = cleaned(observation, self._log, self._camera)
        mended = self._odometer.smooth(finite, self._log)
        self._rests.take(mended)
        return mended

    def _is_stamped(self, observation: object) -> bool:
        """Tell whether this is an observation with a valid stamp."""
        stamp_ns: Any = observation.stamp_ns if isinstance(observation, Observation) else None
        if isinstance(stamp_ns, Integral) and abs(int(stamp_ns)) <= STAMP_MAX_NS:
            return True
        self._log.add("observation left out, it has no stamp in nanoseconds", f"stamp {stamp_ns}")
        return False

    def _skip(self, observation: Observation) -> None:
        kind = "observation left out, its stamp repeats, runs backwards or jumps"
        self._log.add(kind, at_stamp(observation.stamp_ns))

    def _tell_of_rests(self) -> None:
        """Log gaps in which the robot stood still; no data are lost, so they are no faults."""
        rests = self._rests.rests
        if rests:
            _LOG.warning(
                "the robot rested and nothing was recorded, %d times, at most for %.1f s",
                len(rests),
                max(gap.duration_s for gap in rests),
            )
