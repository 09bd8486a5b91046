"""Log the inputs of all decisions, and repeat the decisions from the log alone."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, fields, replace
from typing import Any

from sceneslam.bus.decision import GO_ON, Decision, Health, Situation, StandbyTrial, decide
from sceneslam.bus.events import EventLog
from sceneslam.bus.policy import Policy
from sceneslam.types.run import Event


class DecisionLog:
    """Logs a situation whenever more than its time changed, and every verdict but `go on`."""

    def __init__(self, log: EventLog) -> None:
        self._log = log
        self._last: Situation | None = None

    def add(self, now: Situation, verdict: Decision) -> None:
        """Log a decision with its inputs."""
        if now != self._last or verdict != GO_ON:
            self._log.add("situation", **_in_json(now), verdict=_in_json(verdict))
        self._last = now


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
                wrong += _check(policy, replace(now, stamp_ns=pending), _in_json(GO_ON))
            pending = stamp_ns if state == "run" else None
        elif kind == "situation":
            now, pending = _situation(event), None
            wrong += _check(policy, now, event["verdict"])
        elif kind == "state":
            state = event["to"]
    return wrong


def _check(policy: Policy, now: Situation, logged: Any) -> list[str]:
    verdict = _in_json(decide(policy, now))
    if verdict == logged:
        return []
    return [f"at {now.stamp_ns}: logged {logged['action']}, decided {verdict['action']}"]


def _situation(event: Event) -> Situation:
    values = {field.name: event[field.name] for field in fields(Situation)}
    values |= {"health": Health(values["health"]), "trial": StandbyTrial(values["trial"])}
    values |= {key: tuple(values[key]) for key in ("choices", "served_choices")}
    return Situation(**values | {"tried": frozenset(values["tried"])})


def _in_json(record: Situation | Decision) -> dict[str, Any]:
    """Return a record in its JSON form."""
    form: dict[str, Any] = json.loads(json.dumps(asdict(record), default=sorted))
    return form
