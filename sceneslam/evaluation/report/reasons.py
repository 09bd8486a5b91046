"""Sentences on why a module was chosen, how it was handed the pose, and the cost of that."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sceneslam.evaluation.report.summary import degrees, jump, number
from sceneslam.types.run import Event

_HEALTH = {
    "held": "was tracking",
    "lost": "had been lost for {since:.2f} s",
    "silent": "had got no data for {since:.2f} s",
    "suspect": "had reported another motion than the wheels for {since:.2f} s",
    "failed": "had failed",
}


def why_chosen(
    decision: Event,
    situation: Event | None,
    at_once: Sequence[Event],
    switch: Mapping[str, Any],
    origin_ns: int,
) -> Iterator[str]:
    """Yield sentences about a decision.

    `situation` holds its inputs, `at_once` the events of its stamp, `switch` its entry in the
    metrics, empty for the first choice.
    """
    if situation is None:
        yield f"It is the table's first choice for {decision['scene']}."
    else:
        yield _situation(decision, situation)
        yield _candidates(decision, situation)
    for event in at_once:
        if event["event"] == "handover" and event["module"] == decision["to"] and switch:
            yield _handover(event, at_once, origin_ns)
    yield _effect(switch)
    for event in at_once:
        if event["event"] == "cost" and event["module"] == decision["to"]:
            yield _cost(event)


def _situation(decision: Event, now: Event) -> str:
    since_s = (now["stamp_ns"] - now["unheld_since_ns"]) * 1e-9
    health = _HEALTH[now["health"]].format(since=since_s)
    active = f"“{now['active']}” {health}" if now["active"] else "No module was left"
    if decision["reason"] == "scene":
        return f"The scene asks for it; {active}."
    if decision["reason"] == "return":
        scene = now["served_scene"]
        return f"It is the first choice for {scene}, and tracks beside “{now['active']}”."
    bridge = "constant velocity" if now["is_blind"] else "odometry"
    return f"{active}; {bridge} bridged meanwhile." if now["health"] != "failed" else f"{active}."


def _candidates(decision: Event, now: Event) -> str:
    asked = now["verdict"]["to"]
    if len(asked) < 2 and asked[:1] == [decision["to"]]:
        return ""
    return f"Candidates, best first: {', '.join(asked)}."


def _handover(event: Event, at_once: Sequence[Event], origin_ns: int) -> str:
    kind, from_s = event["kind"], (event["from_ns"] - origin_ns) * 1e-9
    revised = sum(e["poses"] for e in at_once if e["event"] == "revised")
    if not revised:
        return f"Handed over ({kind}) at the pose of that instant."
    return (
        f"Handed over ({kind}) in the past, at the last trusted pose before {from_s:.2f} s: "
        f"{revised} poses reported since then were replaced, and the current one moved by "
        f"{number(event['jump_m'], 3, ' m')} and {degrees(event['jump_rad'])}."
    )


def _effect(switch: Mapping[str, Any]) -> str:
    if not switch or switch["gap_s"] is None:
        return ""
    gap = f"{switch['gap_s']:.2f} s without a pose" if switch["gap_s"] else "no gap"
    if not switch["jump_is_error"]:  # how far the current pose moved is a sentence of its own
        return f"{gap[0].upper()}{gap[1:]}."
    return f"Error of the motion across it: {jump(switch, 4)}; {gap}."


def _cost(event: Event) -> str:
    spent_ms = event["handover_ms"]
    cost = f"Cost: {number(spent_ms, 0 if spent_ms >= 10.0 else 1, ' ms')} of computing"
    if event.get("catch_up_s"):
        cost += f", for {event['catch_up_s']:.1f} s of the recording led through the new module"
    return f"{cost}."
