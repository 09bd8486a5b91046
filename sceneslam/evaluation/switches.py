"""All switches of a run: time, reason, delay, and effect on the trajectory."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import covered, interpolated
from sceneslam.types import se3
from sceneslam.types.run import Event, RunResult
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import TRUTH_GAP_S, GroundTruth, SceneChange


@dataclass(frozen=True, slots=True, kw_only=True)
class Seam:
    """The poses on either side of a hand-over; bridged poses may lie between them."""

    before: int  # last pose that a module gave
    after: int  # first pose of the module that took over


def list_switches(
    result: RunResult, truth: GroundTruth | None, scenes: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Return one entry for every decision that replaced a module, for `metrics.json`.

    `jump_m` and `jump_rad` are the error of the estimated motion across the seam against the true
    motion, if `jump_is_error`; else how far the hand-over moved the current pose, which is no
    error. None is unknown: a module without a pose before it was replaced has neither jump nor gap.
    `confirm_delay_s` is the time from the true change that a switch is the first to answer until
    the new module takes over. `scenes` maps own scenes to the truth's names.
    """
    decisions = [event for event in result.events if is_switch(event)]
    return [_describe(decision, result, truth, scenes) for decision in decisions]


def count_false(
    switches: Sequence[dict[str, Any]],
    truth: GroundTruth | None,
    detected: Collection[str],
    scenes: Mapping[str, str],
) -> int | None:
    """Return how many switches followed a scene that was not the true one; None without truth.

    `detected` are the scenes that the detector found. If the truth contains none of their names, it
    is about other scenes, and the result is None. `scenes` maps own scenes to the truth's names.
    """
    named = {scenes.get(scene, scene) for scene in detected}
    if truth is None or not {change.scene for change in truth.scenes} & named:
        return None
    by_scene = [switch for switch in switches if switch["reason"] == "scene"]
    false = [
        s
        for s in by_scene
        if true_scene(truth, _decided_ns(s)) != scenes.get(s["scene"], s["scene"])
    ]
    return len(false)


def is_switch(event: Event) -> bool:
    """Tell whether an event is a decision that replaced a module."""
    return event["event"] == "decision" and event.get("from") is not None


def true_scene(truth: GroundTruth, stamp_ns: int) -> str | None:
    """Return the true scene at an instant, None before the first that is known."""
    change = _change_in_force(truth, stamp_ns)
    return change.scene if change else None


def find_seam(result: RunResult, decision: Event) -> Seam | None:
    """Return the seam of a switch, None when there is no pose on one of its sides.

    Poses after the next decision do not belong to this switch. With `rewind` the new module also
    gives poses for stamps before the decision; the seam is where its poses begin.
    """
    modules = np.array(result.modules, dtype=object)
    stamps_ns = result.trajectory.stamps_ns
    if decision["from"] == decision["to"] and decision["reason"] == "lost":  # it began anew
        begun_ns = _same_stamp(result.events, "handover", decision).get("from_ns", 0)
        after = int(np.searchsorted(stamps_ns, begun_ns))
        return Seam(before=after - 1, after=after) if 0 < after < len(stamps_ns) else None
    own = (modules == decision["to"]) & _in_turn(result, decision)
    later = np.flatnonzero(own & (stamps_ns >= decision["stamp_ns"]))
    if not len(later):
        return None
    others = np.flatnonzero(~own[: later[0]])
    given = np.flatnonzero(~own[: later[0]] & (modules[: later[0]] != ""))
    if not len(given):
        return None
    return Seam(before=int(given[-1]), after=int(others[-1]) + 1)


def _in_turn(result: RunResult, decision: Event) -> NDArray[np.bool_]:
    """Tell of each pose whether it lies in the turn that a decision began.

    A turn lies between the same module's last one and the next decision. A pose at the very stamp
    at which a module is replaced is still its own.
    """
    stamps_ns = result.trajectory.stamps_ns
    decisions = [event for event in result.events if event["event"] == "decision"]
    at = next(k for k, event in enumerate(decisions) if event is decision)
    inside = np.ones(len(stamps_ns), bool)
    for earlier in decisions[:at]:
        if earlier["from"] == decision["to"]:
            inside &= stamps_ns > earlier["stamp_ns"]
    if at + 1 < len(decisions):
        following = decisions[at + 1]
        began = following["from"] == decision["to"]  # else it could not even be activated
        inside &= stamps_ns < following["stamp_ns"] + int(began)
    return inside


def _describe(
    decision: Event, result: RunResult, truth: GroundTruth | None, scenes: Mapping[str, str]
) -> dict[str, Any]:
    handover = _same_stamp(result.events, "handover", decision)
    cost = _same_stamp(result.events, "cost", decision)
    seam = find_seam(result, decision)
    T_error = _motion_error(result, truth, seam) if seam else None
    jump_m, jump_rad = _jump(T_error, handover) if seam else (None, None)
    return {
        "stamp_ns": int(decision["stamp_ns"]),
        "decided_ns": _decided_ns(decision),
        "scene": decision["scene"],
        "from": decision["from"],
        "to": decision["to"],
        "reason": decision["reason"],
        "confirm_delay_s": _confirm_delay_s(decision, result.events, truth, scenes),
        "gap_s": _gap_s(result, seam) if seam else None,
        "jump_m": jump_m,
        "jump_rad": jump_rad,
        "jump_is_error": T_error is not None,
        "cost_ms": cost.get("handover_ms"),
        "first_pose_ms": cost.get("first_pose_ms"),
        "catch_up_s": cost.get("catch_up_s"),
    }


def _same_stamp(events: Sequence[Event], kind: str, decision: Event) -> Event:
    """Return the event of a kind that belongs to a decision, or an empty one."""
    for event in events:
        same = event["event"] == kind and event["stamp_ns"] == decision["stamp_ns"]
        if same and event["module"] == decision["to"]:
            return event
    return {}


def _confirm_delay_s(
    decision: Event,
    events: Sequence[Event],
    truth: GroundTruth | None,
    scenes: Mapping[str, str],
) -> float | None:
    """Return the time since the true change that a switch answers, None when it answers none.

    Only the first decision for the new scene answers a change: a later one is for another own name
    of the same scene, or takes a wrong scene back.
    """
    change = _change_in_force(truth, _decided_ns(decision)) if truth else None
    if truth is None or change is None or change is truth.scenes[0]:
        return None
    answers = (
        event
        for event in events
        if event["event"] == "decision"
        and event["reason"] == "scene"
        and _decided_ns(event) >= change.stamp_ns
        and scenes.get(event["scene"], event["scene"]) == change.scene
    )
    if next(answers, None) is not decision:
        return None
    return float(decision["stamp_ns"] - change.stamp_ns) * 1e-9


def _decided_ns(decision: Mapping[str, Any]) -> int:
    """Return when a switch was decided; the new module takes over once it has started."""
    return int(decision.get("decided_ns", decision["stamp_ns"]))


def true_changes(truth: GroundTruth) -> list[SceneChange]:
    """Return the first scene and the changes that really changed it."""
    return [next(group) for _, group in groupby(truth.scenes, key=lambda change: change.scene)]


def _change_in_force(truth: GroundTruth, stamp_ns: int) -> SceneChange | None:
    """Return the last change up to an instant that really changed the scene (or is the first)."""
    changes = [change for change in true_changes(truth) if change.stamp_ns <= stamp_ns]
    return changes[-1] if changes else None


def _jump(T_error: Transform | None, handover: Event) -> tuple[float | None, float | None]:
    """Return the error of the motion, or else the motion of the current pose: [m] and [rad]."""
    if T_error is None:
        return handover.get("jump_m"), handover.get("jump_rad")
    return float(np.linalg.norm(T_error[:3, 3])), float(se3.rotation_angle_rad(T_error))


def _gap_s(result: RunResult, seam: Seam) -> float:
    """Return the longest time without a pose across the seam, less the usual period."""
    stamps_ns = result.trajectory.stamps_ns[seam.before : seam.after + 1]
    steps_ns = np.diff(result.observed_ns)
    period_ns = float(np.median(steps_ns)) if len(steps_ns) else 0.0
    return max(0.0, (float(np.diff(stamps_ns).max()) - period_ns) * 1e-9)


def _motion_error(result: RunResult, truth: GroundTruth | None, seam: Seam) -> Transform | None:
    """Return inv(true motion) @ estimated motion over the seam, None where truth is missing."""
    if truth is None:
        return None
    ends = [seam.before, seam.after]
    stamps_ns = result.trajectory.stamps_ns[ends]
    if len(covered(truth.trajectory, stamps_ns, TRUTH_GAP_S)) < 2:
        return None
    T_gt_before, T_gt_after = interpolated(truth.trajectory, stamps_ns).T_world_base
    T_map_before, T_map_after = result.trajectory.T_world_base[ends]
    true_motion = se3.inverse(T_gt_before) @ T_gt_after
    return np.asarray(se3.inverse(true_motion) @ se3.inverse(T_map_before) @ T_map_after)
