"""What a run is worth: a weighted sum of its metrics, the smaller the better."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import TrialResult


class Objective:
    """Weighs metrics by their dotted names in `metrics.json`.

    Of a list (`switches`) the number of entries counts, and of a number in its entries
    (`switches.confirm_delay_s`) the mean, 0 without entries. A value that is not known counts
    as `unknown`.
    """

    def __init__(self, *, weights: Mapping[str, float], unknown: float) -> None:
        if not weights:
            raise ConfigError("weights", dict(weights), "one or more metrics with their weights")
        self.weights, self._unknown = weights, unknown

    def of(self, outcome: TrialResult) -> float:
        """Return the weighted sum of a run."""
        return sum(weight * self.value(outcome, name) for name, weight in self.weights.items())

    def value(self, outcome: TrialResult, name: str) -> float:
        """Return a metric of a run; raises ConfigError where a run has no such metric."""
        value = _find(outcome.metrics, name)
        return self._unknown if math.isnan(value) else value


def _find(metrics: Any, name: str) -> float:
    """Return a metric by its dotted name, NaN where it is not known."""
    for word in name.split("."):
        if isinstance(metrics, Sequence):
            metrics = [entry[word] for entry in metrics if entry.get(word) is not None]
        elif isinstance(metrics, Mapping) and word in metrics:
            metrics = metrics[word]
        else:
            raise ConfigError(f"objective.weights.{name}", word, "a name in metrics.json")
    if isinstance(metrics, list):
        is_plain = metrics and not isinstance(metrics[0], Mapping)
        return fmean(metrics) if is_plain else float(len(metrics))
    return math.nan if metrics is None else float(metrics)
