"""A run in a few lines for the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from sceneslam.evaluation.gaps import in_words
from sceneslam.evaluation.metrics import Metrics

_MAX_LINES, _MAX_COLUMNS = 9, 120
_MAX_SWITCHES = 3  # the others are counted; the report has all of them


def summary_lines(metrics: Metrics) -> list[str]:
    """Return at most nine short lines that say how a run went."""
    first = [_what_was_seen(metrics), _who_worked(metrics)]
    last = [_faults_line(metrics["faults"])] if metrics["faults"] else []
    if metrics["ate_rmse_m"] is not None:
        last.append(_accuracy_line(metrics))
    if "reference" in metrics:
        last.append(_reference_line(metrics["reference"]))
    last += metrics["notes"][:1]
    last.append(_cost_line(metrics))
    return [*first, *_switch_lines(metrics, _MAX_LINES - len(first) - len(last)), *last]


def seconds(metrics: Metrics, stamp_ns: int) -> float:
    """Return an instant as seconds since the first observation."""
    return (stamp_ns - (metrics["start_ns"] or 0)) * 1e-9


def number(value: float | None, digits: int = 3, unit: str = "", scale: float = 1.0) -> str:
    """Return a number with its unit, or a dash for what is not known."""
    return "–" if value is None else f"{value * scale:.{digits}f}{unit}"


def percent(value: float | None, digits: int = 1) -> str:
    """Return a share as a percentage, or a dash for what is not known."""
    return number(value, digits, " %", 100.0)


def degrees(value_rad: float | None, digits: int = 2) -> str:
    """Return an angle in degrees, or a dash for what is not known."""
    return number(value_rad, digits, "°", math.degrees(1.0))


def jump(switch: Mapping[str, Any], digits: int) -> str:
    """Return the jump of a switch, empty if it is unknown or the pose did not move at all."""
    jump_m, jump_rad = switch["jump_m"], switch["jump_rad"]
    if jump_m is None or not (switch["jump_is_error"] or jump_m or jump_rad):
        return ""
    return f"{number(jump_m, digits, ' m')} and {degrees(jump_rad)}"


def _what_was_seen(metrics: Metrics) -> str:
    dropped = f" ({metrics['dropped']} dropped)" if metrics["dropped"] else ""
    p50_ms, p99_ms = metrics["latency_ms"]["p50"], metrics["latency_ms"]["p99"]
    latency = "" if p50_ms is None else f", stamp to pose {p50_ms:.0f} ms (p99 {p99_ms:.0f})"
    return (
        f"{metrics['observations']} observations in {metrics['duration_s']:.1f} s{dropped}, "
        f"{metrics['poses']} poses (coverage {percent(metrics['coverage'])}), "
        f"path {metrics['path_length_m']:.2f} m{latency}"
    )


def _who_worked(metrics: Metrics) -> str:
    shares = [f"{key} {percent(module['share'], 0)}" for key, module in metrics["modules"].items()]
    why = in_words(metrics["bridged_why"])
    bridged = f"{metrics['bridged']} poses bridged{f' ({why})' if why else ''}"
    return f"modules: {', '.join(shares) or 'none'}; {bridged}"


def _switch_lines(metrics: Metrics, room: int) -> list[str]:
    """Return a line per switch, as many as there is room for, and one that counts the others."""
    switches = metrics["switches"]
    fit_all = len(switches) <= min(_MAX_SWITCHES, room)
    shown = len(switches) if fit_all else min(_MAX_SWITCHES, room - 1)
    lines = [_switch_line(metrics, switch) for switch in switches[:shown]]
    if len(switches) > shown:
        lines.append(f"and {len(switches) - shown} more switches (see report.html)")
    return lines


def _switch_line(metrics: Metrics, switch: dict[str, Any]) -> str:
    delay_s = switch["confirm_delay_s"]
    delay = "" if delay_s is None else f", {delay_s:.2f} s after the change"
    what = f"{switch['from']} -> {switch['to']}"
    if switch["from"] == switch["to"]:
        what = f"{switch['to']} began anew"
    name = "jump" if switch["jump_is_error"] else "moved by"
    jumped = f"{name} {size}, " if (size := jump(switch, 3)) else ""
    return (
        f"{seconds(metrics, switch['stamp_ns']):.1f} s: {what} "
        f"({switch['reason']}: {switch['scene']}){delay}, {jumped}"
        f"gap {number(switch['gap_s'], 2, ' s')}"
    )


def _faults_line(faults: list[str]) -> str:
    line = " ".join(f"faults: {len(faults)}, first: {faults[0]}".split())
    return line if len(line) <= _MAX_COLUMNS else line[: _MAX_COLUMNS - 1] + "…"


def _accuracy_line(metrics: Metrics) -> str:
    return (
        f"against ground truth: ATE {number(metrics['ate_rmse_m'], 4, ' m')} "
        f"(max {number(metrics['ate_max_m'], 3, ' m')}), "
        f"rotation {degrees(metrics['ate_rot_rad'])}, "
        f"RPE {number(metrics['rpe_trans_m'], 4, ' m')} {degrees(metrics['rpe_rot_rad'])}, "
        f"correct {percent(metrics['correct_rate'])}, "
        f"false switches {number(metrics['false_switches'], 0)}"
    )


def _reference_line(reference: Metrics) -> str:
    return (
        f"difference from the reference: at most {number(reference['max_difference_m'], 3, ' m')}, "
        f"RMS {number(reference['rms_difference_m'], 3, ' m')} "
        f"({reference['matched']} poses)"
    )


def _cost_line(metrics: Metrics) -> str:
    return (
        f"{number(metrics['realtime_factor'], 2)} x real time, "
        f"bus {number(metrics['bus_overhead_us']['median'], 0, ' us')}, "
        f"detector {number(metrics['detector_us']['median'], 0, ' us')} per observation, "
        f"peak memory {number(metrics['peak_rss_mb'], 0, ' MB')}"
    )
