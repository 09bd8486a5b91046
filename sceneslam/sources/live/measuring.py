"""Common part of the live sources."""

from __future__ import annotations

from collections.abc import Sequence

from sceneslam.interfaces import LiveFeed
from sceneslam.sources.live.clock import StampClock
from sceneslam.sources.live.streams import Streams
from sceneslam.types.observation import Observation
from sceneslam.types.run import Event
from sceneslam.types.truth import GroundTruth


class Measuring:
    """The methods that are the same for all live sources; a source is its own feed."""

    def __init__(self) -> None:
        self._clock = StampClock()
        self._streams: Streams | None = None  # None before iteration

    @property
    def length(self) -> int | None:
        """Return None: the length of a live source is unknown."""
        return None

    @property
    def live(self) -> LiveFeed | None:
        """Return self."""
        return self

    def ground_truth(self) -> GroundTruth | None:
        """Return None: a live source has no ground truth."""
        return None

    def measured_ns(self, observation: Observation) -> int:
        """Return the time [ns] at which an observation was measured, on the monotonic clock."""
        return self._clock.measured_ns(observation.stamp_ns)

    def notices(self) -> Sequence[Event]:
        """Return the events of the streams since the last call."""
        return self._streams.notices() if self._streams is not None else ()

    def close(self) -> None:
        """End the iteration and release all resources."""
        raise NotImplementedError
