"""How a run is carried out."""

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
_MOST_THREADS = 256  # of OpenCV, which starts as many as it is asked for


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
    rate: float  # live, of a recording: so many times as fast as it was recorded
    silent_after_s: float  # live: the events name a source that gave nothing for so long ...
    end_after_s: float | None  # ... and the run ends after so long; null: never
    is_repeatable: bool  # modules wait for what they compute beside the poses
    catch_up_steps: int | None  # remembered observations per new one, at a hand-over; null: all

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
        """Return the limits of a module's process; raises ConfigError where one makes no sense."""
        return Limits(**self._part(Limits))

    @property
    def live(self) -> LiveSettings:
        """Return how time passes in a live run; raises ConfigError where that makes no sense."""
        return LiveSettings(**self._part(LiveSettings))

    def _part(self, settings: type[Limits] | type[LiveSettings]) -> dict[str, Any]:
        return {one.name: getattr(self, one.name) for one in fields(settings)}
