"""Depth that is missing for a while, on any source with depth: as in sunlight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sceneslam.interfaces import Source
from sceneslam.ros.pixels import locked
from sceneslam.sources.wrapped import Wrapped
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.truth import GroundTruth


class DepthGap(Wrapped):
    """Empties the depth images of some stretches; colour and all else stay.

    `gaps_s` is a list of [from, to] in seconds after the first observation.
    """

    def __init__(self, source: Source, gaps_s: list[list[float]]) -> None:
        for gap_s in gaps_s:
            if len(gap_s) != 2 or not 0 <= gap_s[0] < gap_s[1]:
                raise ConfigError("gaps_s", gap_s, "[from, to], seconds, rising, from 0")
        super().__init__(source)
        self._gaps_s = gaps_s

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations, in the gaps with depth images that show nothing."""
        start_ns: int | None = None
        for observation in self._source:
            start_ns = observation.stamp_ns if start_ns is None else start_ns
            time_s = (observation.stamp_ns - start_ns) * 1e-9
            is_blind = any(since_s <= time_s < until_s for since_s, until_s in self._gaps_s)
            if is_blind and observation.depth_m is not None:
                yield replace(observation, depth_m=locked(np.zeros_like(observation.depth_m)))
            else:
                yield observation

    def ground_truth(self) -> GroundTruth | None:
        """Return the source's truth."""
        return self._source.ground_truth()
