"""Decide which module runs: a pure function of what is known at an observation.

Its inputs are logged whenever they change, so that a run's decisions can be made again from the
log alone (`python -m sceneslam.decisions RUN`).
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from sceneslam.bus.judging.hold import Health
from sceneslam.bus.policy import Policy


class StandbyTrial(StrEnum):
    """State of the scene's first choice, on standby beside the fallback that runs in its place."""

    NONE = "none"
    RUNNING = "running"
    PASSED = "passed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """All that a decision depends on."""

    stamp_ns: int = field(compare=False)
    scene: str  # as confirmed by the detector
    served_scene: str  # the scene that the active module was chosen for
    active: str  # "" while no module is active
    health: Health
    unheld_since_ns: int  # since when health has not been HELD
    held_ns: int  # how long it had tracked before that, without a break
    is_blind: bool  # poses are bridged by constant velocity only
    choices: tuple[str, ...]  # modules of `scene` that can run, in the table's order
    served_choices: tuple[str, ...]  # the same for `served_scene`
    tried: frozenset[str]  # choices tried since the scene was confirmed or one tracked for long
    rounds: int  # how often all choices were tried and failed
    trial: StandbyTrial
    retry_ns: int  # when the first choice may be tried again
    may_return: bool  # any scene's module may run later: the run may go on without one
    adrift_since_ns: int | None = None  # since when the active one is lost where it could begin


class Action(StrEnum):
    """What to do with the active module."""

    GO_ON = "go on"
    TELL = "tell"  # the scene changed, the module stays
    SWITCH = "switch"
    TRY = "try"  # run the first choice on standby beside the fallback


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """A decision and its reason."""

    action: Action
    to: tuple[str, ...] = ()  # candidates, best first
    reason: str = ""
    rounds: int = 0  # the new count of rounds in which all choices failed


DOUBLINGS = 3  # of a wait after a failure, at most: from 2 s to 16 s
BLIND = 0.1  # share of the patience: constant velocity errs more than ten times as much as wheels
GO_ON = Decision(action=Action.GO_ON)


def decide(policy: Policy, now: Situation) -> Decision:
    """Return what to do at an observation: by the scene, the trial, then the module's health."""
    if now.scene != now.served_scene and now.choices:
        if now.choices[0] == now.active and now.health is not Health.FAILED:
            return Decision(action=Action.TELL, reason="scene")
        return Decision(action=Action.SWITCH, to=now.choices, reason="scene")
    if now.trial is StandbyTrial.PASSED:
        return Decision(action=Action.SWITCH, to=now.served_choices[:1], reason="return")
    if now.health is Health.HELD:
        return _decide_on_trial(policy, now)
    return _decide_on_loss(policy, now)


def _decide_on_trial(policy: Policy, now: Situation) -> Decision:
    """Return whether the first choice, after it was lost or refused, is tried again."""
    first = now.served_choices[:1]
    is_due = now.trial is StandbyTrial.NONE and now.stamp_ns >= now.retry_ns
    if not is_due or first in ((), (now.active,)) or policy.handover == "cold":
        return GO_ON
    return Decision(action=Action.TRY, to=first)


def _decide_on_loss(policy: Policy, now: Situation) -> Decision:
    """Return whether another module has to take over from one without a usable pose.

    Modules that were tried may be tried again in two cases: the active one had tracked for a
    window before it was lost, or no other module is left and it has been lost for a window. The
    window doubles with each round, `DOUBLINGS` times at most, so that modules do not alternate. A
    module that sees enough, and for long nothing of its map, begins anew where no other takes over.
    """
    lost_ns = now.stamp_ns - now.unheld_since_ns
    window_ns = round(policy.confirm_window_s * 1e9)
    # Two modules that both disagree with the wheels do not alternate: the wheels bridge meanwhile.
    may_return = now.stamp_ns >= now.retry_ns or now.health is not Health.SUSPECT
    barred = (now.active,) if may_return else (now.active, *now.served_choices[:1])
    others = tuple(key for key in now.served_choices if key not in barred)
    left, rounds = tuple(key for key in others if key not in now.tried), now.rounds
    if now.held_ns >= window_ns or (now.health is Health.FAILED and not left):
        left, rounds = others, 0
    elif not left and lost_ns >= window_ns << min(now.rounds, DOUBLINGS):
        left, rounds = others, now.rounds + 1
    if _is_adrift(policy, now):
        left = (*left, now.active)  # anew, with an empty map
    patience_s = policy.lost_patience_s * (BLIND if now.is_blind else 1.0)
    is_over = now.health is Health.FAILED or lost_ns >= round(patience_s * 1e9)
    is_waiting = not left and not now.active and now.may_return
    if not is_over or is_waiting or (not left and now.health is not Health.FAILED):
        return GO_ON
    return Decision(action=Action.SWITCH, to=left, reason=now.health.value, rounds=rounds)


def _is_adrift(policy: Policy, now: Situation) -> bool:
    if now.health is not Health.LOST or now.adrift_since_ns is None:
        return False
    return now.stamp_ns - now.adrift_since_ns >= round(policy.retry_s * 1e9)


def in_json(record: Situation | Decision) -> dict[str, Any]:
    """Return a record in its JSON form."""
    form: dict[str, Any] = json.loads(json.dumps(asdict(record), default=sorted))
    return form
