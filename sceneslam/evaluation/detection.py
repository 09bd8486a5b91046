"""Compare the confirmed scenes with the true ones, independent of the modules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

from sceneslam.evaluation.switches import true_changes, true_scene
from sceneslam.types.run import Event
from sceneslam.types.truth import GroundTruth

Seen = Sequence[tuple[int, str]]  # (stamp, confirmed scene)


def score_detection(
    confirmed: Sequence[Event],
    truth: GroundTruth | None,
    end_ns: int,
    scenes: Mapping[str, str],
) -> dict[str, Any]:
    """Return scores of a run's `scene` events; None where the true scenes are needed but missing.

    A true change is found if its scene is confirmed before the next true change; `delay_s` is the
    mean over those found, 0 for a scene that was confirmed too early. A confirmation of a scene
    other than the true one is false. `wrong_s` is how long the confirmed scene was not the true
    one, until `end_ns`. `scenes` maps own scenes to the ground truth's names for them.
    """
    scores: dict[str, Any] = {"confirmed": len(confirmed)}
    names = ("false", "missed", "delay_s", "delay_max_s", "wrong_s")
    renamed = [
        (int(event["stamp_ns"]), scenes.get(str(event["scene"]), str(event["scene"])))
        for event in confirmed
    ]
    seen = [next(group) for _, group in groupby(renamed, key=lambda pair: pair[1])]
    if truth is None or not truth.scenes or not _are_of(truth, seen):
        return scores | dict.fromkeys(names)
    delays_s = _delays_s(seen, truth, end_ns)
    found_s = [delay_s for delay_s in delays_s if delay_s is not None]
    values = (
        sum(true_scene(truth, stamp_ns) != scene for stamp_ns, scene in seen),
        len(delays_s) - len(found_s),
        sum(found_s) / len(found_s) if found_s else None,
        max(found_s, default=None),
        _wrong_s(seen, truth, end_ns),
    )
    return scores | dict(zip(names, values, strict=True))


def _are_of(truth: GroundTruth, seen: Seen) -> bool:
    """Tell whether the truth contains the confirmed scenes, or no scene was confirmed."""
    return not seen or bool({change.scene for change in truth.scenes} & {name for _, name in seen})


def _delays_s(seen: Seen, truth: GroundTruth, end_ns: int) -> list[float | None]:
    """Return the delay [s] of each true change, None if it was not found."""
    changes = [change for change in true_changes(truth) if change.stamp_ns <= end_ns]
    stops_ns = [*(change.stamp_ns for change in changes[2:]), end_ns + 1]
    delays_s: list[float | None] = []
    for change, stop_ns in zip(changes[1:], stops_ns, strict=False):
        detected = [*_until(seen, change.stamp_ns)[-1:], *_between(seen, change.stamp_ns, stop_ns)]
        found_ns = next((ns for ns, scene in detected if scene == change.scene), None)
        late_ns = None if found_ns is None else max(found_ns - change.stamp_ns, 0)
        delays_s.append(None if late_ns is None else late_ns / 1e9)
    return delays_s


def _until(seen: Seen, stamp_ns: int) -> Seen:
    return [(ns, scene) for ns, scene in seen if ns <= stamp_ns]


def _between(seen: Seen, start_ns: int, stop_ns: int) -> Seen:
    return [(ns, scene) for ns, scene in seen if start_ns < ns < stop_ns]


def _wrong_s(seen: Seen, truth: GroundTruth, end_ns: int) -> float:
    """Return how long the confirmed scene was wrong, from the first confirmation on."""
    if not seen:
        return 0.0
    turns = {ns for ns, _ in seen} | {change.stamp_ns for change in true_changes(truth)}
    stamps_ns = sorted(ns for ns in turns if seen[0][0] <= ns < end_ns)
    wrong_ns = 0
    for start_ns, stop_ns in pairwise([*stamps_ns, end_ns]):
        _, scene = _until(seen, start_ns)[-1]
        wrong_ns += (stop_ns - start_ns) * (scene != true_scene(truth, start_ns))
    return wrong_ns / 1e9
