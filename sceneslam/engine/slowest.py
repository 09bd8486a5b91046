"""Which poses of a live run came latest, and what their time went to."""

from __future__ import annotations

import heapq
from time import perf_counter_ns, thread_time_ns

from sceneslam.types.run import SlowPose

_KEPT = 10


class Stopwatch:
    """Measures the parts of the work on one observation, in the thread that does it."""

    def __init__(self) -> None:
        self.restart()

    @property
    def cpu_ms(self) -> float:
        """Return the thread's own time since the restart; the rest it waited."""
        return (thread_time_ns() - self._cpu_ns) / 1e6

    def restart(self) -> None:
        """Begin with another observation."""
        self.parts_ms: dict[str, float] = {}
        self._cpu_ns, self._since_ns = thread_time_ns(), perf_counter_ns()

    def lap(self, part: str) -> float:
        """Return, and keep as a part's, the time [ms] since the last lap."""
        now_ns = perf_counter_ns()
        self.parts_ms[part] = (now_ns - self._since_ns) / 1e6
        self._since_ns = now_ns
        return self.parts_ms[part]


class Slowest:
    """Keeps the slowest poses."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, SlowPose]] = []

    def has_room(self, latency_ms: float) -> bool:
        """Tell whether a pose that took so long would be kept."""
        return len(self._heap) < _KEPT or latency_ms > self._heap[0][0]

    def add(self, pose: SlowPose) -> None:
        """Take a pose; it is kept while fewer than ten were slower."""
        heapq.heappush(self._heap, (pose.latency_ms, pose.stamp_ns, pose))
        if len(self._heap) > _KEPT:
            heapq.heappop(self._heap)

    @property
    def poses(self) -> tuple[SlowPose, ...]:
        """Return what was kept, the slowest first."""
        return tuple(pose for _, _, pose in sorted(self._heap, reverse=True))
