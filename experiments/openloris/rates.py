"""Correct Rates of one system: alone, of odometry alone, and of both under the policy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sceneslam.types.experiment import Table


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """The rates [%] of a system on a sequence, or their mean over several."""

    system: str
    scene: str  # "" in a mean over several
    name: str  # of the sequence, or of what the mean is over
    duration_s: float
    alone: float
    odometry: float
    together: float
    told: float  # together, as reported online: without what was revised later
    ate_odometry_m: float  # absolute trajectory error, RMSE
    ate_together_m: float

    @property
    def margin(self) -> float:
        """Return how far together is above the better of the two [points]."""
        return self.together - max(self.alone, self.odometry)


_NUMBERS = ("alone", "odometry", "together", "told", "ate_odometry_m", "ate_together_m")


def mean(rates: Sequence[Rates], name: str) -> Rates:
    """Return the mean of one system's rates by duration, as the data set's authors weigh them."""
    total_s = sum(one.duration_s for one in rates)
    values = {
        number: sum(getattr(one, number) * one.duration_s for one in rates) / total_s
        for number in _NUMBERS
    }
    return Rates(system=rates[0].system, scene="", name=name, duration_s=total_s, **values)


def table(rates: Sequence[Rates]) -> Table:
    """Return one line per entry."""
    columns = (
        "system",
        "sequences",
        "duration [s]",
        "alone [%]",
        "odometry [%]",
        "together [%]",
        "online [%]",
        "ATE odometry [m]",
        "ATE together [m]",
        "above the better [points]",
    )
    rows = [
        (
            one.system,
            one.name,
            one.duration_s,
            *(getattr(one, number) for number in _NUMBERS),
            one.margin,
        )
        for one in rates
    ]
    return Table(columns=columns, rows=rows)
