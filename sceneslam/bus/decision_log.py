"""Log the inputs of all decisions, and repeat the decisions from the log alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, fields, replace
from enum import Enum
from operator import attrgetter
from typing import Any

from sceneslam.bus.decision import GO_ON, Decision, Health, Situation, StandbyTrial, decide
from sceneslam.bus.events import EventLog
from sceneslam.bus.policy import Policy
from sceneslam.types.run import Event

_FACTS = attrgetter(*(field.name for field in fields(Situation) if field.name != "stamp_ns"))


class DecisionLog:
    """Logs a situation whenever more than its time changed, and every verdict but `go on`."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._last: tuple[Any, ...] | None = None

    def add(self, now: Situation, verdict: Decision) -> None:
        """Log a decision with its inputs."""
        facts = _FACTS(now)
        is_known, self._last = facts == self._last, facts
        if is_known and verdict == GO_ON:
            return
        values = {key: _plain(value) for key, value in asdict(now).items() if key != "stamp_ns"}
        verdict_fields = {key: _plain(value) for key, value in asdict(verdict).items()}
        self._log.add("situation", now.stamp_ns, **values, verdict=verdict_fields)


def decide_again(events: Iterable[Event], policy: Policy) -> list[str]:
    """Return one sentence for every logged decision that its logged inputs do not reproduce.

    The log holds a vote for every observation and every change of situation; each of them in the
    state `run` is decided again.
    """
    wrong: list[str] = []
    state, pending, now = "init", None, None
    for event in events:
        kind, stamp_ns = event["event"], event["stamp_ns"]
        if kind == "vote":
            if pending is not None and now is not None:
                wrong += _check(policy, replace(now, stamp_ns=pending), _plain(asdict(GO_ON)))
            pending = stamp_ns if state == "run" else None
        elif kind == "situation":
            now, pending = _situation(event), None
            wrong += _check(policy, now, event["verdict"])
        elif kind == "state":
            state = event["to"]
    return wrong


def _check(policy: Policy, now: Situation, logged: Any) -> list[str]:
    verdict = _plain(asdict(decide(policy, now)))
    if verdict == logged:
        return []
    return [f"at {now.stamp_ns}: logged {logged['action']}, decided {verdict['action']}"]


def _situation(event: Event) -> Situation:
    values = {field.name: event[field.name] for field in fields(Situation)}
    values |= {"health": Health(values["health"]), "trial": StandbyTrial(values["trial"])}
    values |= {key: tuple(values[key]) for key in ("choices", "served_choices")}
    return Situation(**values | {"tried": frozenset(values["tried"])})


def _plain(value: Any) -> Any:
    """Return a value in its JSON form."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, frozenset):
        return sorted(value)
    return list(value) if isinstance(value, tuple) else value
