"""How a run is carried out."""

from __future__ import annotations

from dataclasses import dataclass

from sceneslam.types.errors import ConfigError

MODES = ("recording", "live")


@dataclass(slots=True, kw_only=True)
class RunSettings:
    """Mode, pace and limits of a run."""

    mode: str  # recording: in step with the data; live: paced by the clock, own thread
    threads: int  # of OpenCV
    progress: bool  # show a progress bar
    max_observations: int | None  # stop after so many, null: all

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError("mode", self.mode, " | ".join(MODES))
        if self.threads < 1:
            raise ConfigError("threads", self.threads, "1 or more")
        if self.max_observations is not None and self.max_observations < 1:
            raise ConfigError("max_observations", self.max_observations, "1 or more, or null")
