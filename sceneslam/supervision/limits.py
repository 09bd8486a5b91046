"""Limits of a module's process: deadlines, memory, and number of restarts."""

from __future__ import annotations

from dataclasses import dataclass, fields
from time import monotonic, sleep

from sceneslam.types.errors import ConfigError, ModuleError

_DOUBLINGS = 30  # more would be years


@dataclass(slots=True, kw_only=True)
class Limits:
    """Limits of one module's process; durations are wall clock time."""

    step_deadline_s: float  # to track one observation
    start_deadline_s: float  # to be built, to be activated, to return its map
    memory_limit_mb: int  # of its private memory
    restarts_max: int  # within the window
    restart_window_s: float
    # Delay of the second start in the window; it doubles with each start, up to the mean interval
    # of starts that the window allows.
    restart_backoff_s: float
    threads: int  # of OpenCV

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("restarts_max", "restart_backoff_s") and not value > 0:
                raise ConfigError(field.name, value, "a number above 0")
            if not value >= 0:
                raise ConfigError(field.name, value, "0 or more")


class Restarts:
    """Decides when a failed module may be restarted, with exponential backoff."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._failures_s: list[float] = []

    def note_failure(self, now_s: float) -> None:
        """Record a failure."""
        self._forget(now_s)
        self._failures_s.append(now_s)

    def is_spent(self, now_s: float) -> bool:
        """Tell whether the failures in the window exceed the allowed restarts."""
        self._forget(now_s)
        return len(self._failures_s) > self._limits.restarts_max

    def wait_s(self, now_s: float) -> float:
        """Return the remaining delay [s] before the next start."""
        self._forget(now_s)
        failures = len(self._failures_s)
        if self.is_spent(now_s):
            due_s = self._failures_s[-self._limits.restarts_max - 1] + self._limits.restart_window_s
        elif failures > 1:
            pace_s = self._limits.restart_window_s / self._limits.restarts_max
            backoff_s = self._limits.restart_backoff_s * 2 ** min(failures - 2, _DOUBLINGS)
            due_s = self._failures_s[-1] + min(backoff_s, pace_s)
        else:
            return 0.0
        return max(due_s - now_s, 0.0)

    def await_start(self) -> None:
        """Sleep until the next start is allowed; raises ModuleError after too many failures."""
        wait_s = self.wait_s(monotonic())
        if self.is_spent(monotonic()):
            raise ModuleError(
                f"it failed more than {self._limits.restarts_max} times within "
                f"{self._limits.restart_window_s:g} s; not started again for {wait_s:.0f} s"
            )
        sleep(wait_s)

    def _forget(self, now_s: float) -> None:
        """Remove the failures that are older than the window."""
        begin_s = now_s - self._limits.restart_window_s
        self._failures_s = [time_s for time_s in self._failures_s if time_s > begin_s]
