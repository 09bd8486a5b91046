"""Statistics of the observations of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

_EVERY = 30  # every 30th depth image and scan is examined


class Tally:
    """Counts observations per sensor; records where a sensor of the active module was missing."""

    def __init__(self, sensors: frozenset[Sensor]) -> None:
        self.missing: dict[int, str] = {}  # stamp [ns] -> missing sensors of the module
        self._order = [sensor for sensor in Sensor if sensor in sensors]
        self._observations = 0
        self._counts: Counter[Sensor] = Counter()
        self._depths: list[tuple[float, float]] = []  # median [m], share of pixels measured
        self._returns: list[float] = []  # share of beams

    def add(self, observation: Observation, requires: Sequence[frozenset[Sensor]]) -> None:
        """Add an observation; the active module requires one of the given sets of sensors."""
        self._observations += 1
        held = [sensor for sensor in self._order if observation.has(sensor)]
        self._counts.update(held)
        lacking = [needed.difference(held) for needed in requires]
        if lacking and all(lacking):
            self.missing[observation.stamp_ns] = _named(min(lacking, key=len))
        self._look_into(observation)

    def words(self) -> str:
        """Return the statistics as the end of a sentence."""
        parts = [f"{self._counts[sensor]} with {self._named(sensor)}" for sensor in self._order]
        return f"of {self._observations} observations, {', '.join(parts) or 'none with a sensor'}"

    def _look_into(self, observation: Observation) -> None:
        depth_m, scan = observation.depth_m, observation.scan
        if depth_m is not None and self._counts[Sensor.DEPTH] % _EVERY == 1:
            sample = depth_m[::8, ::8]
            measured = sample[sample > 0]
            median_m = float(np.median(measured)) if len(measured) else float("nan")
            self._depths.append((median_m, len(measured) / max(sample.size, 1)))
        if scan is not None and self._counts[Sensor.SCAN] % _EVERY == 1:
            self._returns.append(float(np.isfinite(scan.ranges_m).mean()))

    def _named(self, sensor: Sensor) -> str:
        name = sensor.words
        if sensor is Sensor.DEPTH and self._depths:
            medians_m, shares = np.array(self._depths).T
            known = medians_m[np.isfinite(medians_m)]
            median = f"median {np.median(known):.2f} m" if len(known) else "no depth in range"
            return f"{name} ({median}, {np.median(shares):.0%} of the pixels)"
        if sensor is Sensor.SCAN and self._returns:
            return f"{name} ({np.median(self._returns):.0%} of the beams return)"
        return name


def _named(sensors: frozenset[Sensor]) -> str:
    return " and ".join(sensor.words for sensor in Sensor if sensor in sensors)
