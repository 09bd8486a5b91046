"""Convert a run's event log to readable entries: what happened, when, and why."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sceneslam.evaluation.report.reasons import why_chosen
from sceneslam.types.run import Event, RunResult

_SHORT_S = 0.5  # shorter trouble is only counted
_TOLD_TROUBLES = 5  # of one kind and module; more are summed up


_OF_INPUT = {  # events of the input and of the map -> text
    "silent": "the source was silent for {for_s:g} s",
    "returned": "the source is back",
    "behind": "the recording was read too slowly, and is played {by_s:.1f} s later",
    "given_up": "the source was silent for {for_s:g} s, and the run ended",
    "stream_silent": "{topic} was silent for {for_s:g} s",
    "stream_returned": "{topic} is back",
    "clock_jump": "the clock of {topic} jumped by {jumped_s:g} s",
    "relocalized": "the run relocalized in the loaded map",
    "not_relocalized": "the run did not relocalize in the loaded map within {after_s:.1f} s",
    "relocalization_withdrawn": "the loaded map is contradicted: the run is separated from it",
    "odometry_jump": "odometry jumped: it was reset, or its motion was impossible",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Trouble:
    """A period in which a module did not track normally."""

    what: str  # "“key” is lost"
    stamp_ns: int
    lasted_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One entry; `details` are sentences."""

    at_s: float  # since the first observation
    kind: str  # scene | decision | trouble | fault
    what: str
    details: tuple[str, ...] = ()


def chronicle(
    result: RunResult, switches: Sequence[Mapping[str, Any]], *, value_label: str
) -> list[Entry]:
    """Return the entries of a run, ordered by time; `switches` are those of its metrics."""
    origin_ns = int(result.observed_ns[0]) if len(result.observed_ns) else 0
    return _Writer(result.events, switches, origin_ns, value_label).write()


class _Writer:
    """Goes through the log once, with the state that later entries refer to."""

    def __init__(
        self,
        events: Sequence[Event],
        switches: Sequence[Mapping[str, Any]],
        origin_ns: int,
        value_label: str,
    ) -> None:
        self._events, self._origin_ns, self._label = events, origin_ns, value_label
        self._switches = {(s["stamp_ns"], s["to"]): s for s in switches}
        self._entries: list[Entry] = []
        self._situation: Event | None = None  # the last that led to a change of module
        self._values: list[tuple[int, float]] = []
        self._trouble: Event | None = None
        self._troubles: list[_Trouble] = []

    def write(self) -> list[Entry]:
        """Return all entries."""
        tellers: Mapping[str, Callable[[Event], None]] = {
            "vote": self._keep_value,
            "scene": self._tell_scene,
            "situation": self._tell_situation,
            "refused": self._tell_refusal,
            "decision": self._tell_decision,
            "tracking": self._tell_tracking,
            "suspect": self._tell_suspicion,
            "fault": self._tell_fault,
            "dropped": self._tell_dropped,
            **dict.fromkeys(_OF_INPUT, self._tell_input),
        }
        for event in self._events:
            if event["event"] in tellers:
                tellers[event["event"]](event)
        end_ns = max((event["stamp_ns"] for event in self._events), default=0)
        self._end_trouble(end_ns)
        self._tell_troubles(end_ns)
        return sorted(self._entries, key=lambda entry: entry.at_s)

    def _add(self, stamp_ns: int, kind: str, what: str, *details: str) -> None:
        at_s = self._seconds(stamp_ns)
        given = tuple(detail for detail in details if detail)
        self._entries.append(Entry(at_s=at_s, kind=kind, what=what, details=given))

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._origin_ns) * 1e-9

    def _keep_value(self, event: Event) -> None:
        value = event.get("value")
        if value is not None and math.isfinite(value):
            self._values.append((event["stamp_ns"], value))

    def _tell_scene(self, event: Event) -> None:
        since_ns = event.get("since_ns", event["stamp_ns"])
        seen = [value for stamp_ns, value in self._values if stamp_ns >= since_ns]
        values = f"{self._label} {_range(seen)}" if seen and self._label else ""
        if event["previous"] is None:
            what, agreed = f"First scene: {event['scene']}", ""
        else:
            what = f"The scene changed from {event['previous']} to {event['scene']}"
            agreed = self._why_confirmed(event, since_ns)
        why = ", ".join(filter(None, [agreed, values]))
        self._add(event["stamp_ns"], "scene", what, f"{why}." if why else "")

    def _why_confirmed(self, event: Event, since_ns: int) -> str:
        """Return as text why a scene was confirmed: all images of a window, or its probability."""
        votes = (e for e in self._events if e["event"] == "vote" and "posterior" in e)
        cast = next((e for e in votes if e["stamp_ns"] == event["stamp_ns"]), None)
        since = f"since {self._seconds(since_ns):.2f} s"
        if cast is None:
            return f"All images {since} agree"
        probability = 100.0 * float(cast["posterior"][event["scene"]])
        return f"Its probability has risen {since}, to {probability:.1f} %"

    def _tell_situation(self, event: Event) -> None:
        action = event["verdict"]["action"]
        if action == "switch":
            self._situation = event
        elif action == "try":
            first = event["verdict"]["to"][0]
            waited = f"“{event['active']}” runs in its place and is tracking."
            self._add(event["stamp_ns"], "decision", f"“{first}” is tried again", waited)
        elif action == "tell":
            what = f"“{event['active']}” stays for {event['scene']}"
            self._add(event["stamp_ns"], "decision", what, "It is the table's choice there, too.")

    def _tell_refusal(self, event: Event) -> None:
        whys = {"lost": "it was lost itself", "silent": "it got no data", "failed": "it failed"}
        why = whys.get(event["why"], event["why"])
        self._add(event["stamp_ns"], "decision", f"“{event['to']}” was not taken: {why}")

    def _tell_decision(self, event: Event) -> None:
        if self._trouble is not None and self._trouble["module"] != event["to"]:
            self._end_trouble(event["stamp_ns"])
        replaced = event.get("from")
        what = f"“{event['to']}” takes over from “{replaced}”" if replaced else ""
        if replaced == event["to"]:
            what = f"“{replaced}” begins anew"
        switch = self._switches.get((event["stamp_ns"], event["to"]), {})
        mine = [e for e in self._events if e["stamp_ns"] == event["stamp_ns"]]
        details = why_chosen(event, self._situation, mine, switch, self._origin_ns)
        self._add(event["stamp_ns"], "decision", what or f"“{event['to']}” begins", *details)
        self._situation = None

    def _tell_tracking(self, event: Event) -> None:
        self._end_trouble(event["stamp_ns"])
        if event["status"] != "tracking":
            self._trouble = event

    def _end_trouble(self, stamp_ns: int) -> None:
        event, self._trouble = self._trouble, None
        if event is None:
            return
        began_ns = event["stamp_ns"]
        what = f"“{event['module']}” is {event['status']}"
        lasted_s = (stamp_ns - began_ns) * 1e-9
        self._troubles.append(_Trouble(what=what, stamp_ns=began_ns, lasted_s=lasted_s))

    def _tell_troubles(self, end_ns: int) -> None:
        """Write long troubles one by one, many of a kind together; count the short ones."""
        long = [one for one in self._troubles if one.lasted_s >= _SHORT_S]
        for what in dict.fromkeys(one.what for one in long):
            same = [one for one in long if one.what == what]
            if len(same) > _TOLD_TROUBLES:
                self._sum_up(same)
                continue
            for one in same:
                self._add(one.stamp_ns, "trouble", f"{what} for {one.lasted_s:.1f} s")
        passing = len(self._troubles) - len(long)
        if passing:
            times = "once" if passing == 1 else f"{passing} times"
            what = f"Also, tracking was impaired {times} for less than {_SHORT_S:g} s"
            self._add(end_ns, "trouble", what)

    def _sum_up(self, same: Sequence[_Trouble]) -> None:
        worst = max(same, key=lambda one: one.lasted_s)
        at_s = self._seconds(worst.stamp_ns)
        self._add(
            same[0].stamp_ns,
            "trouble",
            f"{same[0].what} {len(same)} times from here on",
            f"{sum(one.lasted_s for one in same):.1f} s in all, at most {worst.lasted_s:.1f} s "
            f"(at {at_s:.1f} s); the figure shows when.",
        )

    def _tell_suspicion(self, event: Event) -> None:
        what = f"“{event['module']}” is rejected"
        why = "It reported another motion than the wheels; poses are bridged until they agree."
        self._add(event["stamp_ns"], "trouble", what, why)

    def _tell_fault(self, event: Event) -> None:
        self._add(event["stamp_ns"], "fault", str(event["what"]))

    def _tell_dropped(self, event: Event) -> None:
        if event["count"]:
            what = f"{event['count']} observations were dropped in all, as newer ones arrived"
            self._add(event["stamp_ns"], "fault", what)

    def _tell_input(self, event: Event) -> None:
        what = _OF_INPUT[event["event"]]
        kind = "decision" if event["event"] == "relocalized" else "trouble"
        self._add(event["stamp_ns"], kind, what.format(**event))


def _range(values: Sequence[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"
