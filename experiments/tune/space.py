"""The keys that are searched, and between which values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from sceneslam.types.errors import ConfigError

if TYPE_CHECKING:
    from optuna import Trial as Draw

Value = float | int | str | bool
_ALLOWED = "{key, low, high, log: true or false} with low < high, or {key, choices}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One key of the configuration and the values that it may take."""

    key: str  # as on the command line: detector.threshold
    low: float = 0.0
    high: float = 0.0
    log: bool = False  # drawn by its logarithm
    choices: tuple[Value, ...] = ()  # in place of low and high

    def draw(self, draw: Draw) -> Value:
        """Return a value; numbers have four digits, so that a file holds what was run.

        Where both bounds are whole, so is the value.
        """
        if self.choices:
            return cast(Value, draw.suggest_categorical(self.key, self.choices))
        if isinstance(self.low, int) and isinstance(self.high, int):
            return int(draw.suggest_int(self.key, self.low, self.high, log=self.log))
        value = draw.suggest_float(self.key, self.low, self.high, log=self.log)
        return float(f"{value:.4g}")


def read_space(space: Mapping[str, Mapping[str, Any]]) -> Sequence[Parameter]:
    """Return the parameters of a configuration; raises ConfigError for `space`."""
    if not space:
        raise ConfigError("space", dict(space), "one or more parameters")
    found = []
    for name, node in space.items():
        try:
            values: dict[str, Any] = {**node, "choices": tuple(node.get("choices") or ())}
            found.append(Parameter(**values))
        except (TypeError, AttributeError):
            raise ConfigError(f"space.{name}", node, _ALLOWED) from None
        one = found[-1]
        if not one.choices and not (one.low < one.high and (one.low > 0 or not one.log)):
            raise ConfigError(f"space.{name}", node, f"{_ALLOWED}, above 0 with log")
    return found
