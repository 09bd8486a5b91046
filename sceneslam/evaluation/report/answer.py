"""The summary of a report: did the run work, if not where and why, and what to change."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.report.summary import number, percent

_SHARE = 0.01  # of the observations: a smaller share gives no advice
_CORRECT = 0.99  # of the time
_LATE = 0.05  # of the duration: a later first pose is in the headline
_ADVICE = (  # part of the reason for a missing pose -> advice
    (
        r"while (.+) was lost",
        "“{0}” lost track. Give its scene another module to fall back on, as in "
        "scenes.NAME=[{0},OTHER], or one that suits it better: "
        "python -m sceneslam list slam.",
    ),
    (
        r"while (.+) was rejected",
        "“{0}” reported another motion than the wheels. If the wheels are wrong: policy.gate=null.",
    ),
    (
        r"before a module tracked",
        "The first pose came late. Look at the first seconds of the recording: what the module "
        "needs may not be there yet.",
    ),
    (
        r"after a module failed",
        "A module failed. run.isolation=process gives it a process of its own, which is restarted.",
    ),
    (
        r"without (.+)",
        "At these times the module was without {0}. Look at the sensor{or_tolerance}.",
    ),
)

_OR_TOLERANCE = ", or at source.sync_tolerance_s where its stamps lie apart from the images'"


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """The summary, in plain sentences."""

    kind: str  # worked | partly | failed
    headline: str
    where: Sequence[str]  # what went wrong, where and why
    advice: Sequence[str]  # what to change


def answer(
    metrics: Metrics,
    faults: Sequence[str],
    source: Collection[str],
    *,
    first_pose_s: float,
) -> Answer:
    """Return whether a run worked.

    `faults` are errors of the input, or why the run ended early; `source` the keys of the source.
    `first_pose_s` counts from the first observation.
    """
    where = list(dict.fromkeys([*faults, *metrics["shortfalls"]]))
    advice = [*dict.fromkeys(_advice(metrics, source))]
    if not metrics["poses"]:
        return Answer(kind="failed", headline="It did not work.", where=where, advice=advice)
    rate, false = metrics["correct_rate"], metrics["false_switches"]
    if rate is not None and rate < _CORRECT:
        largest = number(metrics["ate_max_m"], 2, " m")
        where.append(
            f"The pose was correct for {percent(rate)} of the time, and off by {largest} at most."
        )
    if false:
        where.append(f"{false} changes of module followed a wrong scene.")
    if where:
        return Answer(kind="partly", headline="It worked in part.", where=where, advice=advice)
    late = first_pose_s > _LATE * metrics["duration_s"]
    at = f" (at {first_pose_s:.1f} of {metrics['duration_s']:.1f} s)" if late else ""
    share = percent(metrics["coverage"])
    summary = f"from the first pose on{at}, {share} of the observations have a pose"
    if metrics["ate_rmse_m"] is not None:
        summary += f", {number(metrics['ate_rmse_m'], 3, ' m')} off (root mean square)"
    return Answer(kind="worked", headline=f"It worked: {summary}.", where=[], advice=advice)


def _advice(metrics: Metrics, source: Collection[str]) -> Iterator[str]:
    """Yield advice on the most frequent causes of missing poses, then on wrong switches."""
    or_tolerance = _OR_TOLERANCE if "sync_tolerance_s" in source else ""
    least = _SHARE * metrics["observations"]
    for reason, count in _reasons(metrics).items():
        if count < least:
            continue
        for pattern, advice in _ADVICE:
            if match := re.fullmatch(pattern, reason):
                yield advice.format(*match.groups(), or_tolerance=or_tolerance)
                break
    if metrics["false_switches"]:
        yield (
            "Look at the detector's figure: the threshold (detector.threshold) should lie between "
            "the scenes, and policy.confirm_window_s be longer than flicker."
        )


def _reasons(metrics: Metrics) -> Mapping[str, int]:
    """Return the reasons for bridged or missing poses, with the number of poses, most first."""
    reasons: Counter[str] = Counter(metrics["bridged_why"]) + Counter(metrics["missing_why"])
    return dict(reasons.most_common())
