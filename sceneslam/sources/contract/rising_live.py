"""A wrapper for live sources: ensures rising stamps, finite arrays and smooth odometry."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import numpy as np

from sceneslam.interfaces import LiveFeed, Source
from sceneslam.sources.changes.wrapped import Wrapped
from sceneslam.sources.contract.clean import cleaned
from sceneslam.sources.contract.odometer import Odometer
from sceneslam.sources.faults import FaultLog, at_stamp
from sceneslam.types.observation import Observation
from sceneslam.types.run import Event


class RisingLive(Wrapped):
    """Leaves out observations whose stamps do not rise; adds no delay."""

    def __init__(self, source: Source, feed: LiveFeed) -> None:
        super().__init__(source)
        self._feed = feed
        self._log = FaultLog()
        self._notices: list[Event] = []
        self._lock = threading.Lock()

    @property
    def live(self) -> LiveFeed | None:
        """Return self: its notices include corrections of odometry."""
        return self

    @property
    def faults(self) -> Sequence[str]:
        """Return the source's faults and counts of what was left out here."""
        return [*self._source.faults, *self._log.sentences()]

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations by rising stamp."""
        odometer, last_ns, camera = Odometer(), None, self._source.rig.camera
        for observation in self._source:
            stamp_ns = observation.stamp_ns
            if last_ns is not None and stamp_ns <= last_ns:
                self._log.add("observation left out, its stamp does not rise", at_stamp(stamp_ns))
                continue
            last_ns, before = stamp_ns, odometer.T_smooth_odom
            mended = odometer.smooth(cleaned(observation, self._log, camera), self._log)
            if not np.array_equal(before, odometer.T_smooth_odom):
                T_smooth_odom = odometer.T_smooth_odom.ravel().tolist()
                self._tell("odometry_jump", stamp_ns, T_smooth_odom=T_smooth_odom)
            yield mended

    def measured_ns(self, observation: Observation) -> int:
        """Return the time [ns] at which an observation was measured, on the monotonic clock."""
        return self._feed.measured_ns(observation)

    def notices(self) -> Sequence[Event]:
        """Return the source's events, and jumps of odometry.

        The event `odometry_jump` holds the correction of the measured odometry from then on:
        `T_smooth_odom`, 16 numbers row by row.
        """
        with self._lock:
            notices, self._notices = self._notices, []
        return [*self._feed.notices(), *notices]

    def close(self) -> None:
        """Close the source."""
        self._feed.close()

    def _tell(self, event: str, stamp_ns: int, **fields: object) -> None:
        with self._lock:
            self._notices.append({"event": event, "stamp_ns": stamp_ns, **fields})
