"""What happened in a run, in plain sentences."""

from __future__ import annotations

from typing import Any

from sceneslam.evaluation.gaps import in_words
from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.report.summary import jump, number, percent, seconds

_TOLD_SWITCHES = 8
_WHY = {
    "scene": "the scene was confirmed to be {scene}",
    "lost": "“{from}” had lost track",
    "silent": "the sensors of “{from}” had gone silent",
    "suspect": "“{from}” reported another motion than the wheels",
    "failed": "“{from}” had failed",
    "return": "it was tracking again beside “{from}”",
}


def tell(metrics: Metrics) -> list[str]:
    """Return a run as a few paragraphs, without a term that needs the manual."""
    paragraphs = [_opening(metrics)]
    described = metrics["switches"][:_TOLD_SWITCHES]
    if described:
        paragraphs.append(" ".join(_change(metrics, switch) for switch in described))
    if len(metrics["switches"]) > len(described):
        paragraphs.append("The later changes are in the table below.")
    return [*paragraphs, _accuracy(metrics)] if metrics["poses"] else paragraphs


def _opening(metrics: Metrics) -> str:
    if not metrics["observations"]:
        return "The source gave no observations, so there is nothing to report."
    seen = f"{metrics['observations']} observations over {metrics['duration_s']:.1f} s"
    if metrics["dropped"]:
        seen += f" ({metrics['dropped']} more were dropped, as newer ones arrived)"
    if not metrics["poses"]:
        return f"The run processed {seen}, but no module ever gave a pose."
    text = (
        f"The run processed {seen}. From the first pose on, {percent(metrics['coverage'])} of them "
        f"got a pose; the path is {metrics['path_length_m']:.2f} m long."
    )
    if metrics["bridged"]:
        why = in_words(metrics["bridged_why"])
        text += f" {metrics['bridged']} poses were bridged, since no module gave them: {why}."
    if not metrics["switches"]:
        worked = [key for key, module in metrics["modules"].items() if module["poses"]]
        text += f" {_names(worked)} gave the poses; nothing was switched."
    return text


def _names(keys: list[str]) -> str:
    return " and ".join(f"“{key}”" for key in keys) or "No module"


def _change(metrics: Metrics, switch: dict[str, Any]) -> str:
    why = _WHY.get(switch["reason"], switch["reason"]).format(**switch)
    is_same = switch["from"] == switch["to"]
    what = "began anew" if is_same else f"took over from “{switch['from']}”"
    text = f"At {seconds(metrics, switch['stamp_ns']):.1f} s “{switch['to']}” {what}, because {why}"
    if switch["confirm_delay_s"] is not None:
        text += f", {switch['confirm_delay_s']:.2f} s after it really changed"
    if switch["gap_s"] is None:
        return text + "."
    gap = f"no pose for {switch['gap_s']:.2f} s" if switch["gap_s"] else "no gap"
    size = jump(switch, 3)
    if switch["jump_is_error"]:
        return text + f"; the trajectory is off by {size} across the change and has {gap}."
    moved = f"the current pose was moved by {size}, and " if size else ""
    return text + f"; {moved}the trajectory has {gap}."


def _accuracy(metrics: Metrics) -> str:
    if metrics["ate_rmse_m"] is None:
        return "No ground truth is known at these times, so no error can be given."
    text = (
        f"Against the ground truth the position is off by {number(metrics['ate_rmse_m'], 3, ' m')} "
        f"(root mean square) and at most {number(metrics['ate_max_m'], 3, ' m')}. "
        f"For {percent(metrics['correct_rate'])} of the time the pose was correct"
    )
    if metrics["false_switches"]:
        return text + f"; {metrics['false_switches']} switches followed a wrong scene."
    return text + "."
