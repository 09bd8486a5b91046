"""The poses of a live run with the largest latency, and the parts of it."""

from __future__ import annotations

import heapq
from time import perf_counter_ns, thread_time_ns

from sceneslam.types.run import SlowPose

_KEPT = 10


class Stopwatch:
    """Measures the durations of the parts of the work on one observation, in its thread."""

    def __init__(self) -> None:
        self.restart()

    @property
    def cpu_ms(self) -> float:
        """Return the thread's CPU time [ms] since the restart."""
        return (thread_time_ns() - self._cpu_ns) / 1e6

    def restart(self) -> None:
        """Restart for the next observation."""
        self.parts_ms: dict[str, float] = {}
        self._cpu_ns, self._since_ns = thread_time_ns(), perf_counter_ns()

    def lap(self, part: str) -> float:
        """Record the time since the last lap as that of a part; return it [ms]."""
        now_ns = perf_counter_ns()
        self.parts_ms[part] = (now_ns - self._since_ns) / 1e6
        self._since_ns = now_ns
        return self.parts_ms[part]


class Slowest:
    """Stores the poses with the largest latency."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, SlowPose]] = []

    def has_room(self, latency_ms: float) -> bool:
        """Tell whether a pose with this latency would be stored."""
        return len(self._heap) < _KEPT or latency_ms > self._heap[0][0]

    def add(self, pose: SlowPose) -> None:
        """Add a pose; the ten with the largest latency are stored."""
        heapq.heappush(self._heap, (pose.latency_ms, pose.stamp_ns, pose))
        if len(self._heap) > _KEPT:
            heapq.heappop(self._heap)

    @property
    def poses(self) -> tuple[SlowPose, ...]:
        """Return the stored poses, by decreasing latency."""
        return tuple(pose for _, _, pose in sorted(self._heap, reverse=True))
