"""Frames between the SDK's threads and the source's: few, the newest win."""

from __future__ import annotations

import threading
from collections import Counter, deque

from sceneslam.sources.realsense.frames import Frame
from sceneslam.types.rig import Sensor

_MOST = {Sensor.IMAGE: 3, Sensor.DEPTH: 3}  # the SDK has 16 buffers of a stream
_MOST_SAMPLES = 1000


class Waiting:
    """Takes frames from any thread and gives them in order."""

    def __init__(self) -> None:
        self._frames: deque[Frame] = deque()
        self._dropped: Counter[str] = Counter()
        self._is_closed = False
        self._changed = threading.Condition()

    @property
    def is_closed(self) -> bool:
        """Tell whether nothing more is given."""
        return self._is_closed

    def put(self, frame: Frame) -> None:
        """Leave a frame; the oldest of its sensor goes where too many wait."""
        with self._changed:
            waiting = [one for one in self._frames if one.sensor is frame.sensor]
            if len(waiting) >= _MOST.get(frame.sensor, _MOST_SAMPLES):
                self._frames.remove(waiting[0])
                self._dropped[frame.sensor.value] += 1
            self._frames.append(frame)
            self._changed.notify()

    def take(self, timeout_s: float) -> Frame | None:
        """Return the oldest frame, None when none came in time or nothing more is given."""
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._is_closed, timeout_s)
            return self._frames.popleft() if self._frames and not self._is_closed else None

    def take_dropped(self) -> Counter[str]:
        """Return how many frames of each sensor were dropped since the last call."""
        with self._changed:
            dropped, self._dropped = self._dropped, Counter()
            return dropped

    def close(self) -> None:
        """Give nothing more."""
        with self._changed:
            self._is_closed = True
            self._frames.clear()
            self._changed.notify_all()
