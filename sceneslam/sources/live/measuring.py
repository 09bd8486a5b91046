"""A source that measures now, but for where its measurements come from."""

from __future__ import annotations

from collections.abc import Sequence

from sceneslam.interfaces import LiveFeed
from sceneslam.sources.live.clock import StampClock
from sceneslam.sources.live.streams import Streams
from sceneslam.types.observation import Observation
from sceneslam.types.run import Event
from sceneslam.types.truth import GroundTruth


class Measuring:
    """Answers what is the same for a robot and a camera: each is its own feed."""

    def __init__(self) -> None:
        self._clock = StampClock()
        self._streams: Streams | None = None  # None until it is iterated

    @property
    def length(self) -> int | None:
        """Return None: nobody knows how long it will last."""
        return None

    @property
    def live(self) -> LiveFeed | None:
        """Return itself."""
        return self

    def ground_truth(self) -> GroundTruth | None:
        """Return None: nobody knows."""
        return None

    def measured_ns(self, observation: Observation) -> int:
        """Return when an observation was measured, by the monotonic clock."""
        return self._clock.measured_ns(observation.stamp_ns)

    def notices(self) -> Sequence[Event]:
        """Return what happened to the streams since the last call."""
        return self._streams.notices() if self._streams is not None else ()

    def close(self) -> None:
        """End the iteration, and free what it took."""
        raise NotImplementedError
