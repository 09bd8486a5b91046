"""Checks of settings, by the names of a constructor's arguments; each raises ConfigError."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

from sceneslam.types.errors import ConfigError

Numbers = float | Sequence[float] | Mapping[str, float]


def check_least(low: float, **settings: Numbers) -> None:
    """Check that settings, or all that they hold, are `low` or more."""
    for name, value in _each(settings):
        if not value >= low:
            raise ConfigError(name, value, f"{low:g} or more")


def check_above(low: float, **settings: Numbers) -> None:
    """Check that settings, or all that they hold, are above `low`."""
    for name, value in _each(settings):
        if not value > low:
            raise ConfigError(name, value, f"a number above {low:g}")


def check_between(low: float, high: float, **settings: Numbers) -> None:
    """Check that settings, or all that they hold, are from `low` to `high`."""
    for name, value in _each(settings):
        if not low <= value <= high:
            raise ConfigError(name, value, f"{low:g} to {high:g}")


def check_inside(low: float, high: float, **settings: Numbers) -> None:
    """Check that settings, or all that they hold, are above `low` and below `high`."""
    for name, value in _each(settings):
        if not low < value < high:
            raise ConfigError(name, value, f"between {low:g} and {high:g}")


def check_among(known: Collection[str], **settings: str | Sequence[str]) -> None:
    """Check that settings, or all that they hold, are names that are known."""
    for name, value in settings.items():
        for word in [value] if isinstance(value, str) else value:
            if word not in known:
                raise ConfigError(name, word, " | ".join(known))


def check_some(**settings: Collection[Any]) -> None:
    """Check that settings are not empty."""
    for name, value in settings.items():
        if not value:
            raise ConfigError(name, value, "one or more")


def ranged(check: Callable[..., None], *limits: float) -> Any:
    """Return a dataclass field that `Checked` checks by one of the functions above."""
    return field(metadata={"check": partial(check, *limits)})


@dataclass(eq=False)
class Checked:
    """Settings whose `ranged` fields are checked; None is in every range."""

    def __post_init__(self) -> None:
        """Raise ConfigError for a value that is out of its range."""
        for each in (one for one in fields(self) if "check" in one.metadata):
            value = getattr(self, each.name)
            if value is not None:
                each.metadata["check"](**{each.name: value})


def _each(settings: Mapping[str, Numbers]) -> Iterator[tuple[str, float]]:
    """Yield every number with the key that a message names."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}.{key}", number) for key, number in value.items())
        elif isinstance(value, Sequence):
            yield from ((name, number) for number in value)
        else:
            yield name, value
