"""What waits for the bus while it works: the newest of every sensor, and every sample between."""

from __future__ import annotations

import threading
from dataclasses import replace
from enum import Enum

from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

# An observation's stamp is theirs: they carry no stamp of their own.
_STAMPED_BY = (Sensor.IMAGE, Sensor.DEPTH, Sensor.POINTS)


class Waited(Enum):
    """What came of waiting, where it was no observation."""

    SILENCE = "nothing came in time"
    END = "nothing will come any more"


class Mailbox:
    """Takes observations as they come, and gives the bus what it has not seen of them yet.

    Of images, depth and points the newest wins: an observation that a newer one replaces before it
    was taken is dropped and counted. Its scan, odometry, gyro and accelerometer samples are not
    lost: what the newer one has none of goes with it. All methods may be called from any thread.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.dropped_images = 0
        self._waiting: list[Observation] = []  # by stamp; none replaces another
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, observation: Observation) -> None:
        """Leave an observation that is newer than all before."""
        with self._changed:
            kept: list[Observation] = []
            for older in reversed(self._waiting):
                if _replaces(observation, older):
                    self.dropped += 1
                    self.dropped_images += older.has(Sensor.IMAGE)
                    observation = _joined(older, observation)
                else:
                    kept.append(older)
            self._waiting = [*reversed(kept), observation]
            self._changed.notify()

    def take(self, timeout_s: float | None = None) -> Observation | Waited:
        """Return the oldest that waits; SILENCE after `timeout_s`, END when closed and empty."""
        with self._changed:
            is_there = self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not is_there:
                return Waited.SILENCE
            return self._waiting.pop(0) if self._waiting else Waited.END

    def close(self, *, is_emptied: bool = False) -> None:
        """Let the taker finish what waits and end; `is_emptied`: at once."""
        with self._changed:
            self._is_closed = True
            if is_emptied:
                self._waiting = []
            self._changed.notify()


def _replaces(newer: Observation, older: Observation) -> bool:
    """Tell whether nothing of the older one is missed that only its own stamp belongs to."""
    return all(newer.has(sensor) for sensor in _STAMPED_BY if older.has(sensor))


def _joined(older: Observation, newer: Observation) -> Observation:
    """Return the newer one with what it lacks: a scan has its own stamp, samples have theirs."""
    joined = newer.with_samples_of(older)
    if joined.scan is None and older.scan is not None:
        joined = replace(joined, scan=older.scan)
    return joined
