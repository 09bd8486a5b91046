"""Settings of a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from sceneslam.engine.live import LiveSettings
from sceneslam.supervision.limits import Limits
from sceneslam.types.errors import ConfigError

DETECT_ONLY = "detect_only"
LIVE = "live"
MODES = ("recording", LIVE, DETECT_ONLY)
ISOLATIONS = ("inline", "process")
_MOST_THREADS = 256  # limit for OpenCV, which starts any number


@dataclass(slots=True, kw_only=True)
class RunSettings:
    """Mode, rate and limits of a run; durations are wall clock time."""

    mode: str  # recording: in step with the data; live: paced by the clock, own thread;
    # detect_only: no SLAM
    isolation: str  # inline: modules in the main process; process: each in its own ...
    step_deadline_s: float  # ... which is killed if it takes longer to track an observation ...
    start_deadline_s: float  # ... to be built, to be activated or to return its map ...
    memory_limit_mb: int  # ... or uses more memory
    restarts_max: int  # largest number of restarts ...
    restart_window_s: float  # ... within any time window of this length ...
    restart_backoff_s: float  # ... delay before the second start, then doubled
    threads: int  # of OpenCV
    progress: bool  # show a progress bar
    report: bool  # draw figures and write report.html
    max_observations: int | None  # stop after this number; null: all
    rate: float  # live, playback rate of a recording; 1: as recorded
    silent_after_s: float  # live: time without data until the event `silent` ...
    end_after_s: float | None  # ... and until the run ends; null: never
    is_repeatable: bool  # poses wait for parallel computations of modules
    catch_up_steps: int | None  # buffered observations per new one at a hand-over; null: all

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError("mode", self.mode, " | ".join(MODES))
        if self.isolation not in ISOLATIONS:
            raise ConfigError("isolation", self.isolation, " | ".join(ISOLATIONS))
        if not 1 <= self.threads <= _MOST_THREADS:
            raise ConfigError("threads", self.threads, f"1 to {_MOST_THREADS}")
        _ = self.limits, self.live  # checks them
        for name in ("max_observations", "catch_up_steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(name, value, "1 or more, or null")
        if self.catch_up_steps == 1:
            raise ConfigError("catch_up_steps", 1, "2 or more, or null: 1 never catches up")

    @property
    def limits(self) -> Limits:
        """Return the limits of a module's process; raises ConfigError for an invalid one."""
        return Limits(**self._part(Limits))

    @property
    def live(self) -> LiveSettings:
        """Return the timing of a live run; raises ConfigError for an invalid value."""
        return LiveSettings(**self._part(LiveSettings))

    def _part(self, settings: type[Limits] | type[LiveSettings]) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in fields(settings)}
