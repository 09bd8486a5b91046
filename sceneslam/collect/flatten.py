"""Conversion of a run's metrics to single numbers with dotted names."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

Number = float | None

# Summaries over all switches of a run: name, entry of the switch, function.
_OF_SWITCHES: Sequence[tuple[str, str, Callable[[Sequence[float]], float]]] = (
    ("confirm_delay_s", "confirm_delay_s", lambda values: sum(values) / len(values)),
    ("confirm_delay_max_s", "confirm_delay_s", max),
    ("switch_gap_max_s", "gap_s", max),
    ("switch_jump_max_m", "jump_m", max),
    ("switch_jump_max_rad", "jump_rad", max),
    ("switch_moved_max_m", "moved_m", max),
    ("switch_moved_max_rad", "moved_rad", max),
    ("switch_cost_ms", "cost_ms", max),
)


def flat(metrics: Mapping[str, object]) -> dict[str, Number]:
    """Return every number of `metrics.json`; for lists the length, for switches summaries."""
    found: dict[str, Number] = {}
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{inner}": number for inner, number in flat(value).items()}
        elif isinstance(value, list):
            found[name] = len(value)
            if name == "switches":
                found |= _switches(value)
        elif value is None or isinstance(value, int | float):
            found[name] = value
    return found


def _switches(switches: Sequence[Mapping[str, object]]) -> dict[str, Number]:
    found: dict[str, Number] = {}
    named = [switch if switch.get("jump_is_error") else _moved(switch) for switch in switches]
    for name, entry, summary in _OF_SWITCHES:
        values = [switch.get(entry) for switch in named]
        known = [float(value) for value in values if isinstance(value, int | float)]
        found[name] = summary(known) if known else None
    return found


def _moved(switch: Mapping[str, object]) -> Mapping[str, object]:
    """Return a switch whose jump is no error but how far the current pose moved."""
    return {name.replace("jump_", "moved_"): value for name, value in switch.items()}
