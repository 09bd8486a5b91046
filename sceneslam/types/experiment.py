"""What an experiment asks of many runs, and what it finds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from sceneslam.types.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One run: how it differs from the experiment's own configuration."""

    name: str  # of its folder
    overrides: Sequence[str] = ()  # as on the command line, after the user's: "+scenario=flicker"
    values: Mapping[str, Any] = field(default_factory=dict)  # laid over what is composed


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrialResult:
    """What a trial gave; its folder holds the rest."""

    trial: Trial
    folder: Path
    metrics: Mapping[str, Any]
    trajectory: Trajectory  # T_map_base, as revised
    online: Trajectory  # as reported at the time
    faults: Sequence[str]


RunTrials = Callable[[Iterable[Trial]], Iterator[TrialResult]]


class Relation(Enum):
    """On which side of its bound a figure has to be."""

    AT_LEAST = ">="
    AT_MOST = "<="
    BETWEEN = "in"  # from `low` to `bound`


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A number that was promised."""

    name: str
    value: float
    relation: Relation
    bound: float
    unit: str = ""
    low: float = -math.inf  # of BETWEEN

    @classmethod
    def at_most(cls, name: str, value: float, bound: float, unit: str = "") -> Figure:
        """Return the promise that a value does not exceed its bound."""
        return cls(name=name, value=value, relation=Relation.AT_MOST, bound=bound, unit=unit)

    @classmethod
    def at_least(cls, name: str, value: float, bound: float, unit: str = "") -> Figure:
        """Return the promise that a value reaches its bound."""
        return cls(name=name, value=value, relation=Relation.AT_LEAST, bound=bound, unit=unit)

    @classmethod
    def between(cls, name: str, value: float, low: float, high: float, unit: str = "") -> Figure:
        """Return the promise of a range, where one side alone can be had for nothing."""
        return cls(
            name=name, value=value, relation=Relation.BETWEEN, bound=high, unit=unit, low=low
        )

    @property
    def holds(self) -> bool:
        """Tell whether the promise is kept; a figure that could not be had (NaN) keeps none."""
        if self.relation is Relation.AT_LEAST:
            return self.value >= self.bound
        return self.low <= self.value <= self.bound


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """The numbers behind the figures; a cell is text, a number or None."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What an experiment found."""

    figures: Sequence[Figure]
    table: Table
    pictures: Mapping[str, str] = field(default_factory=dict)  # PNG in the folder -> its caption

    @property
    def holds(self) -> bool:
        """Tell whether every promise is kept."""
        return all(figure.holds for figure in self.figures)
