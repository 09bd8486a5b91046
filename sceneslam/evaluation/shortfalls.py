"""Why a finished run is incomplete: missing poses, failed modules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sceneslam.evaluation.gaps import in_words, why_without_pose
from sceneslam.types.run import Event, RunResult

NO_POSE = "no pose: "  # begins the error of a run without any pose, before its reason
REFERENCE = "reference: "  # begins the errors of the run that a run is compared with


def shortfalls(result: RunResult, coverage_min_ratio: float) -> list[str]:
    """Return a sentence per failed module, and one if too few observations got a pose."""
    faults = [event for event in result.events if event["event"] == "fault"]
    return [*_coverage(result, coverage_min_ratio), *_failures(faults, _origin_ns(result))]


def _coverage(result: RunResult, least_ratio: float) -> list[str]:
    """Return a sentence if less than a share of the observations got a pose.

    Only observations from the first confirmed scene on count.
    """
    if not len(result.observed_ns) or not len(result.trajectory):
        return []  # that there is no pose at all is said with its reason
    scenes = (int(event["stamp_ns"]) for event in result.events if event["event"] == "scene")
    observed_ns = result.observed_ns[result.observed_ns >= next(scenes, _origin_ns(result))]
    has_pose = np.isin(observed_ns, result.trajectory.stamps_ns)
    ratio = float(has_pose.mean()) if len(has_pose) else 0.0
    if ratio >= least_ratio:
        return []
    why = in_words(why_without_pose(result))
    return [
        f"only {100 * ratio:.0f} % of the observations got a pose "
        f"(evaluation.coverage_min_ratio {least_ratio:g}); without: {why}"
    ]


def _failures(faults: Sequence[Event], origin_ns: int) -> list[str]:
    """Return a sentence per component that failed, even if it was restarted."""
    failed: dict[str, list[Event]] = {}
    for event in faults:
        failed.setdefault(str(event["what"]).partition(" ")[0], []).append(event)
    return [_failure(name, events, origin_ns) for name, events in failed.items()]


def _failure(name: str, events: Sequence[Event], origin_ns: int) -> str:
    first = events[0]
    times = "once" if len(events) == 1 else f"{len(events)} times, first"
    at_s = (first["stamp_ns"] - origin_ns) * 1e-9
    reason = str(first["what"]).removeprefix(f"{name} ")
    return f"{name} failed {times} at {at_s:.1f} s: {reason}"


def _origin_ns(result: RunResult) -> int:
    return int(result.observed_ns[0]) if len(result.observed_ns) else 0
