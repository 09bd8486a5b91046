"""Queue between source and bus: the newest image of each camera, and all samples in between."""

from __future__ import annotations

import threading
from dataclasses import replace
from enum import Enum

from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

# Sensors whose stamp is that of the observation.
_STAMPED_BY = (Sensor.IMAGE, Sensor.DEPTH, Sensor.POINTS)


class Waited(Enum):
    """Result of waiting without an observation."""

    SILENCE = "nothing came in time"
    END = "nothing will come any more"


class Mailbox:
    """Queues observations for the bus; newer ones replace older ones.

    Only the newest images, depth images and clouds are kept: an observation that is replaced before
    it was taken is dropped and counted. Its scan, odometry, gyro and accelerometer samples are
    added to the newer one if missing there. All methods may be called from any thread.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.dropped_images = 0
        self._waiting: list[Observation] = []  # by stamp
        self._is_closed = False
        self._changed = threading.Condition()

    def put(self, observation: Observation) -> None:
        """Add an observation, which must be newer than all before."""
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
        """Return the oldest queued one; SILENCE after `timeout_s`, END if closed and empty."""
        with self._changed:
            is_there = self._changed.wait_for(lambda: self._waiting or self._is_closed, timeout_s)
            if not is_there:
                return Waited.SILENCE
            return self._waiting.pop(0) if self._waiting else Waited.END

    def close(self, *, is_emptied: bool = False) -> None:
        """Close the mailbox; with `is_emptied`, queued observations are dropped."""
        with self._changed:
            self._is_closed = True
            if is_emptied:
                self._waiting = []
            self._changed.notify()


def _replaces(newer: Observation, older: Observation) -> bool:
    """Tell whether the newer one has all sensors of the older one that have no own stamp."""
    return all(newer.has(sensor) for sensor in _STAMPED_BY if older.has(sensor))


def _joined(older: Observation, newer: Observation) -> Observation:
    """Return the newer one with the older one's scan and samples, which have own stamps."""
    joined = newer.with_samples_of(older)
    if joined.scan is None and older.scan is not None:
        joined = replace(joined, scan=older.scan)
    return joined
