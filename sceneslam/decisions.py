"""Repeat a run's decisions from its event log only: `python -m sceneslam.decisions RUN`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from sceneslam.bus.decision import GO_ON, Situation, StandbyTrial, decide, in_json
from sceneslam.bus.judging.hold import Health
from sceneslam.bus.policy import Policy
from sceneslam.config.component import ComponentBuilder
from sceneslam.streams import secure_streams
from sceneslam.types.errors import InputError, SceneSlamError
from sceneslam.types.run import Event


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare; return the exit code: 0 same decisions, 1 different ones, 2 nothing to compare."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if len(words) != 1:
        print("usage: python -m sceneslam.decisions RUN (the folder of a run)", file=sys.stderr)
        return 2
    try:
        events, policy = _read_events(Path(words[0])), _read_policy(Path(words[0]))
        wrong = _checked(events, policy)
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for sentence in wrong:
        print(sentence)
    made = [e for e in events if e["event"] == "situation" and e["verdict"]["action"] != "go on"]
    print(f"{len(made)} decisions logged, {len(wrong)} that do not follow from the log")
    return 1 if wrong else 0


def _checked(events: Sequence[Event], policy: Policy) -> list[str]:
    try:
        return decide_again(events, policy)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the log is of another version: {error!r} in a situation") from error


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
                wrong += _check(policy, replace(now, stamp_ns=pending), in_json(GO_ON))
            pending = stamp_ns if state == "run" else None
        elif kind == "situation":
            now, pending = _situation(event), None
            wrong += _check(policy, now, event["verdict"])
        elif kind == "state":
            state = event["to"]
    return wrong


def _check(policy: Policy, now: Situation, logged: Any) -> list[str]:
    verdict = in_json(decide(policy, now))
    if verdict == logged:
        return []
    return [f"at {now.stamp_ns}: logged {logged['action']}, decided {verdict['action']}"]


def _situation(event: Event) -> Situation:
    values = {field.name: event[field.name] for field in fields(Situation) if field.name in event}
    values |= {"health": Health(values["health"]), "trial": StandbyTrial(values["trial"])}
    values |= {key: tuple(values[key]) for key in ("choices", "served_choices")}
    return Situation(**values | {"tried": frozenset(values["tried"])})


def _read_events(folder: Path) -> list[Event]:
    path = folder / "events.jsonl"
    if not path.is_file():
        raise InputError(f"no event log: {path}")
    events: list[Event] = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            events.append(json.loads(line))
        except ValueError as error:
            raise InputError(f"line {number}: expected JSON, got {line[:60]!r}: {path}") from error
    return events


def _read_policy(folder: Path) -> Policy:
    path = folder / "config.yaml"
    if not path.is_file():
        raise InputError(f"no configuration: {path}")
    try:
        config: Any = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OmegaConfBaseException, ValueError) as error:
        raise InputError(f"not a configuration ({error}): {path}") from error
    return ComponentBuilder(config).make("policy", Policy)


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
