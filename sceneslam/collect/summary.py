"""Means over seeds, with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

from sceneslam.collect.rows import Row, Value, swept_keys

SEED = "seed"
_CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Mean:
    """A mean with the half width of its confidence interval, None for a single value."""

    count: int
    mean: float
    half_width: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """The rows that differ by their seed only, one per seed."""

    keys: dict[str, Value]
    rows: Sequence[Row]

    def mean(self, metric: str) -> Mean | None:
        """Return the mean over the rows with the metric, None if there are none."""
        values = [row.metrics.get(metric) for row in self.rows]
        return mean_of([float(value) for value in values if isinstance(value, int | float)])


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """Return the groups, by the swept keys besides the seed, in the rows' order.

    A run with a seed that its group has already is the same run again: the last one counts.
    """
    keys = [key for key in swept_keys(rows) if key != SEED]
    found: dict[tuple[Value, ...], dict[Value, Row]] = {}
    for row in rows:
        group = found.setdefault(tuple(row.keys.get(key) for key in keys), {})
        group[row.keys.get(SEED)] = row
    return [
        Group(keys=dict(zip(keys, values, strict=True)), rows=list(group.values()))
        for values, group in found.items()
    ]


def mean_of(values: Sequence[float]) -> Mean | None:
    """Return mean and 95 % confidence interval (Student's t, for few normal values)."""
    count = len(values)
    if not count:
        return None
    mean = math.fsum(values) / count
    if count == 1:
        return Mean(count=1, mean=mean, half_width=None)
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (count - 1))
    return Mean(
        count=count, mean=mean, half_width=student_t(count - 1) * deviation / math.sqrt(count)
    )


@cache
def student_t(freedom: int) -> float:
    """Return t for which Student's distribution has a probability of 95 % in [-t, t].

    Bisection on the exact series for integer degrees of freedom (Abramowitz and Stegun 26.7.3-4).
    """
    low, high = 0.0, 1.0
    while _within(high, freedom) < _CONFIDENCE:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _within(middle, freedom) < _CONFIDENCE else (low, middle)
    return high


def _within(t: float, freedom: int) -> float:
    angle = math.atan2(t, math.sqrt(freedom))
    if freedom == 1:
        return 2.0 * angle / math.pi
    total = math.fsum(_terms(math.cos(angle), freedom))
    if freedom % 2:
        return 2.0 / math.pi * (angle + math.sin(angle) * total)
    return math.sin(angle) * total


def _terms(cosine: float, freedom: int) -> Iterator[float]:
    """Yield the series' terms: odd powers of the cosine for odd degrees, even ones for even."""
    power = freedom % 2
    term = cosine if power else 1.0
    while power <= freedom - 2:
        yield term
        term *= cosine**2 * (power + 1) / (power + 2)
        power += 2
