"""How a run is carried out."""

from __future__ import annotations

from dataclasses import dataclass, fields

from sceneslam.supervision.limits import Limits
from sceneslam.types.errors import ConfigError

DETECT_ONLY = "detect_only"
MODES = ("recording", "live", DETECT_ONLY)
ISOLATIONS = ("inline", "process")
_MOST_THREADS = 256  # of OpenCV; it starts as many as it is told, and no machine of ours has more


@dataclass(slots=True, kw_only=True)
class RunSettings:
    """Mode, pace and limits of a run; durations are of the wall clock."""

    mode: str  # recording: in step with the data; live: paced by the clock, own thread;
    # detect_only: no SLAM
    isolation: str  # inline: modules in the bus's own process; process: each in one of its own ...
    step_deadline_s: float  # ... which is ended when it takes longer to track an observation ...
    start_deadline_s: float  # ... to be built, to be activated or to hand over its map ...
    memory_limit_mb: int  # ... or uses more
    restarts_max: int  # it is started again so many times ...
    restart_window_s: float  # ... within any such time ...
    restart_backoff_s: float  # ... waiting so long before the second time, then twice as long
    threads: int  # of OpenCV
    progress: bool  # show a progress bar
    report: bool  # draw figures and write report.html
    max_observations: int | None  # stop after so many, null: all
    catch_up_steps: int | None  # remembered observations per new one, at a hand-over; null: all

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError("mode", self.mode, " | ".join(MODES))
        if self.isolation not in ISOLATIONS:
            raise ConfigError("isolation", self.isolation, " | ".join(ISOLATIONS))
        if not 1 <= self.threads <= _MOST_THREADS:
            raise ConfigError("threads", self.threads, f"1 to {_MOST_THREADS}")
        _ = self.limits  # checks them
        for name in ("max_observations", "catch_up_steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(name, value, "1 or more, or null")
        if self.catch_up_steps == 1:
            raise ConfigError("catch_up_steps", 1, "2 or more, or null: 1 never catches up")

    @property
    def limits(self) -> Limits:
        """Return the limits of a module's process; raises ConfigError where one makes no sense."""
        names = (field.name for field in fields(Limits))
        return Limits(**{name: getattr(self, name) for name in names})
