"""Base class of sources that wrap another source."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.interfaces import Live, LiveFeed, Logged, Source
from sceneslam.sources.spanned import Spanned, TimeSpan
from sceneslam.sources.survey.survey import Survey, Surveyed
from sceneslam.types.errors import ConfigError
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.truth import GroundTruth


class Wrapped:
    """Passes on everything of its source but the observations."""

    def __init__(self, source: Source) -> None:
        self._source = source

    @property
    def rig(self) -> Rig:
        """Return the source's rig."""
        return self._source.rig

    @property
    def length(self) -> int | None:
        """Return the largest possible number of observations, None if unknown."""
        return self._source.length

    @property
    def faults(self) -> Sequence[str]:
        """Return the source's faults."""
        return self._source.faults

    @property
    def live(self) -> LiveFeed | None:
        """Return the source's live feed, None for recordings."""
        return self._source.live if isinstance(self._source, Live) else None

    @property
    def span(self) -> TimeSpan | None:
        """Return the source's time span, None if unknown."""
        return self._source.span if isinstance(self._source, Spanned) else None

    def ground_truth(self) -> GroundTruth | None:
        """Return the source's ground truth, None if unknown."""
        return self._source.ground_truth()

    def survey(self) -> Survey | None:
        """Return the source's survey, None if unknown; effects are not included."""
        return self._source.survey() if isinstance(self._source, Surveyed) else None

    def logged_ns(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the recording's stamps (N,) of observations with `stamps_ns` (N,)."""
        return logged_ns(self._source, stamps_ns)

    def start_ns(self) -> int | None:
        """Return the stamp of the first observation, None where there is none."""
        if self.span is not None:
            return self.span.start_ns
        first = next(iter(self._source), None)
        return None if first is None else first.stamp_ns


def check_sensor(source: Source, sensor: Sensor, **settings: object) -> None:
    """Raise ConfigError for settings that change a sensor if the source does not have it."""
    for name, value in settings.items():
        if sensor not in source.rig.sensors:
            raise ConfigError(name, value, f"with a source that has {sensor.words}")


def logged_ns(source: Source | None, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the stamps (N,) that a recording itself has for observations with `stamps_ns`."""
    return source.logged_ns(stamps_ns) if isinstance(source, Logged) else stamps_ns
