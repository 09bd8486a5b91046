"""Sources whose first and last stamps are known in advance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeSpan:
    """The first and last stamp of a recording."""

    start_ns: int
    end_ns: int


@runtime_checkable
class Spanned(Protocol):
    """A source whose time span is known before it is read."""

    @property
    def span(self) -> TimeSpan | None:
        """Return the stamps of the first and last observation, None when unknown."""
        ...
