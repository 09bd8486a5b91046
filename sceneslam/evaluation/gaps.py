"""Why no module gave a pose at an observation: missing sensor data, or the module's state."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.run import Event, RunResult


def why_bridged(result: RunResult) -> dict[str, int]:
    """Return the number of bridged poses per reason, the most frequent first."""
    stamps_ns = result.trajectory.stamps_ns
    is_bridged = np.array([module == "" for module in result.modules], bool)
    return _reasons(stamps_ns[is_bridged] if len(stamps_ns) else stamps_ns, result)


def why_without_pose(result: RunResult) -> dict[str, int]:
    """Return the number of observations without a pose per reason, the most frequent first."""
    has_pose = np.isin(result.observed_ns, result.trajectory.stamps_ns)
    return _reasons(result.observed_ns[~has_pose], result)


def in_words(reasons: Mapping[str, int]) -> str:
    """Return reasons and their counts as a list in a sentence."""
    return ", ".join(f"{count} {reason}" for reason, count in reasons.items())


def _reasons(stamps_ns: NDArray[np.int64], result: RunResult) -> dict[str, int]:
    events = [one for one in result.events if one["event"] in _STATES]
    events.sort(key=lambda one: int(one["stamp_ns"]))
    counts: Counter[str] = Counter()
    state, place = "before a module tracked", 0
    for stamp_ns in stamps_ns.tolist():
        while place < len(events) and events[place]["stamp_ns"] <= stamp_ns:
            state = _state(events[place], state)
            place += 1
        lacking = "" if result.missing is None else result.missing.get(stamp_ns)
        counts[f"without {lacking}" if lacking else state] += 1
    if result.missing is None and _CHANGING in counts:
        counts["for a reason that was not kept"] = counts.pop(_CHANGING)
    return dict(counts.most_common())


_CHANGING = "during a change of module"
_STATES: Sequence[str] = ("tracking", "suspect", "fault")


def _state(event: Event, state: str) -> str:
    """Return the state of the active module after an event."""
    if event["event"] == "fault":
        return "after a module failed"
    if event["event"] == "suspect":
        return f"while {event['module']} was rejected"
    if event["status"] == "lost":
        return f"while {event['module']} was lost"
    return _CHANGING
