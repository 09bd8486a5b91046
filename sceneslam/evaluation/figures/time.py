"""Figures over time: the detector's votes, the active modules, and the pose errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.figures import style as look
from sceneslam.evaluation.switches import is_switch
from sceneslam.types.run import Event, RunResult
from sceneslam.types.truth import GroundTruth

_NAMED_CHANGES = 8  # more names than these lie on top of each other


def draw_votes(
    result: RunResult, truth: GroundTruth | None, threshold: float | None, value_label: str
) -> Any:
    """Return the detector's value over time (the paper's Fig. 5), None without any value."""
    votes = [e for e in result.events if e["event"] == "vote"]
    values = np.array([e["value"] for e in votes], dtype=float)  # None becomes NaN
    if not np.isfinite(values).any():
        return None
    times_s = look.elapsed_s(result, np.array([e["stamp_ns"] for e in votes], np.int64))
    figure, axes = _over_true_scenes(result, truth)
    curve = look.thinned(times_s, values)
    axes.plot(*curve, color=look.PALETTE[0], linewidth=1.4, label=value_label)
    if threshold is not None:
        axes.axhline(
            threshold,
            color=look.PALETTE[1],
            linestyle="--",
            linewidth=1.4,
            label=f"threshold {threshold:g}",
        )
    _mark_confirmed(axes, result)
    look.style(axes, y_label=value_label)
    axes.set_xlim(0.0, max(look.duration_s(result), 1e-3))
    _leave_room(axes)
    _legend_below(figure, axes)
    return figure


def draw_posterior(result: RunResult, truth: GroundTruth | None) -> Any:
    """Return the scenes' probabilities over time, None if the scene filter has none."""
    votes = [event for event in result.events if event["event"] == "vote" and "posterior" in event]
    if not votes:
        return None
    times_s = look.elapsed_s(result, np.array([e["stamp_ns"] for e in votes], np.int64))
    figure, axes = _over_true_scenes(result, truth)
    for number, scene in enumerate(votes[0]["posterior"]):
        values = np.array([event["posterior"][scene] for event in votes])
        color = look.PALETTE[number % len(look.PALETTE)]
        curve = look.thinned(times_s, values)
        axes.plot(*curve, color=color, linewidth=1.4, label=f"P({scene})")
    _mark_confirmed(axes, result)
    look.style(axes, y_label="probability")
    axes.set_xlim(0.0, max(look.duration_s(result), 1e-3))
    _leave_room(axes)
    _legend_below(figure, axes)
    return figure


def draw_series(
    result: RunResult,
    stamps_ns: NDArray[np.int64],
    values_m: NDArray[np.float64],
    *,
    y_label: str,
    limit_m: float | None = None,
    online_m: NDArray[np.float64] | None = None,
) -> Any:
    """Return a figure of distances (N,) [m] over time with a band per module, None without any.

    `online_m` is the distance of the poses as reported at the time, at the same stamps.
    """
    if not len(values_m):
        return None
    figure = look.new_figure()
    axes = figure.add_subplot()
    look.draw_bands(axes, look.module_spans(result), look.module_colors(result), 0.16)
    times_s = look.elapsed_s(result, stamps_ns)
    rms_m = float(np.sqrt(np.mean(values_m**2)))
    label = f"RMS {rms_m:.3f} m, max {values_m.max():.3f} m"
    marker = "o" if len(values_m) == 1 else None
    if online_m is not None:
        early = look.thinned(times_s, online_m)
        axes.plot(
            *early, color=look.MUTED, linewidth=1.1, dashes=(3, 1), label="as reported online"
        )
    curve = look.thinned(times_s, values_m)
    axes.plot(*curve, color=look.INK, linewidth=1.3, marker=marker, label=label)
    if limit_m is not None:
        axes.axhline(limit_m, color=look.MUTED, linestyle=":", label=f"limit {limit_m:g} m")
    switches = [event for event in result.events if is_switch(event)]
    for event in switches:
        alpha = min(1.0, 20 / len(switches))  # many must not black out the curve
        axes.axvline(_at_s(result, event), color=look.INK, lw=0.9, linestyle="-.", alpha=alpha)
    look.style(axes, y_label=y_label)
    axes.set_xlim(0.0, max(look.duration_s(result), 1e-3))
    axes.set_ylim(bottom=0.0)
    _leave_room(axes)
    _legend_below(figure, axes)
    return figure


def draw_timeline(result: RunResult, truth: GroundTruth | None) -> Any:
    """Return the active modules over time: scenes above, a row per module, troubles hatched."""
    if not len(result.observed_ns):
        return None
    confirmed = _confirmed_spans(result)
    true = look.true_scene_spans(result, truth)
    tints = look.scene_tints(span.label for span in (*true, *confirmed))
    colors = look.module_colors(result)
    rows = [("true scene", true), ("confirmed", confirmed)]
    rows = [(name, bars) for name, bars in rows if bars]
    active = look.module_spans(result)
    rows += [(key, [s for s in active if s.label == key]) for key in colors]
    if any(span.label == "" for span in active):
        rows.append(("bridged", [s for s in active if s.label == ""]))
    figure = look.new_figure(look.WIDTH_IN, 1.3 + 0.45 * len(rows))
    axes = figure.add_subplot()
    for row, (name, bars) in enumerate(rows):
        is_scene = name in ("true scene", "confirmed")
        for bar in bars:
            color = (tints if is_scene else colors).get(bar.label, look.BRIDGED)
            _draw_bar(axes, bar, row, color, name_it=is_scene, total_s=look.duration_s(result))
        _draw_trouble(axes, result, name, row)
    faults_s = [_at_s(result, event) for event in result.events if _is_fault(event)]
    if faults_s:
        axes.plot(faults_s, [len(rows)] * len(faults_s), "x", color=look.INK, clip_on=False)
        rows.append(("faults", []))
    look.style(axes)
    axes.set_yticks(range(len(rows)), [name for name, _ in rows])
    axes.set_ylim(max(len(rows), 1) - 0.4, -0.6)
    axes.set_xlim(0.0, max(look.duration_s(result), 1e-3))
    _key_to_trouble(figure, result)
    return figure


def _over_true_scenes(result: RunResult, truth: GroundTruth | None) -> tuple[Any, Any]:
    """Return a figure and its axes, shaded by the true scenes."""
    figure = look.new_figure()
    axes = figure.add_subplot()
    bands = look.true_scene_spans(result, truth)
    look.draw_bands(axes, bands, look.scene_tints(b.label for b in bands), 0.9)
    return figure, axes


def _at_s(result: RunResult, event: Event) -> float:
    return float(look.elapsed_s(result, np.array([event["stamp_ns"]], np.int64))[0])


def _is_fault(event: Event) -> bool:
    if event["event"] == "dropped":
        return int(event["count"]) > 0  # live mode always reports it
    return bool(event["event"] == "fault")


def _mark_confirmed(axes: Any, result: RunResult) -> None:
    changes = [e for e in result.events if e["event"] == "scene" and e["previous"] is not None]
    for event in changes:
        at_s = _at_s(result, event)
        axes.axvline(
            at_s, color=look.INK, lw=1.1, linestyle="-.", alpha=min(1.0, 20 / len(changes))
        )
        if len(changes) <= _NAMED_CHANGES:
            axes.text(
                at_s,
                0.5,
                f"{event['scene']} confirmed",
                transform=axes.get_xaxis_transform(),
                rotation=90,
                ha="center",
                va="center",
                fontsize=10,
                color=look.INK,
                bbox={"facecolor": look.PAPER, "edgecolor": "none", "alpha": 0.8, "pad": 1.5},
            )


def _confirmed_spans(result: RunResult) -> list[look.LabelledSpan]:
    changes = [e for e in result.events if e["event"] == "scene"]
    times_s = look.elapsed_s(result, np.array([e["stamp_ns"] for e in changes], np.int64))
    return look.spans(times_s, [e["scene"] for e in changes], look.duration_s(result))


def _draw_bar(
    axes: Any, bar: look.LabelledSpan, row: int, color: str, *, name_it: bool, total_s: float
) -> None:
    width_s = max(bar.end_s - bar.start_s, 0.002 * total_s)
    axes.barh(row, width_s, left=bar.start_s, height=0.62, color=color, linewidth=0)
    name, size = look.fitted(axes, bar.label, width_s / max(total_s, 1e-9))
    if name_it and size:
        axes.text(bar.start_s + width_s / 2, row, name, ha="center", va="center", fontsize=size)


def _draw_trouble(axes: Any, result: RunResult, module: str, row: int) -> None:
    for bar in _trouble(result, module):
        hatch = "xxxx" if bar.label == "lost" else "////"
        axes.barh(
            row,
            max(bar.end_s - bar.start_s, 1e-3),
            left=bar.start_s,
            height=0.62,
            hatch=hatch,
            facecolor="none",
            edgecolor=look.INK,
            linewidth=0.4,
        )


def _trouble(result: RunResult, module: str) -> list[look.LabelledSpan]:
    """Return the spans in which a module was not TRACKING, until it was replaced."""
    changes = [e for e in result.events if e["event"] == "tracking" and e["module"] == module]
    times_s = look.elapsed_s(result, np.array([e["stamp_ns"] for e in changes], np.int64))
    found = look.spans(times_s, [e["status"] for e in changes], look.duration_s(result))
    replaced = [e for e in result.events if is_switch(e) and e["from"] == module]
    replaced_s = [*(_at_s(result, e) for e in replaced), float("inf")]
    return [
        look.LabelledSpan(
            s.start_s, min(s.end_s, *(t for t in replaced_s if t >= s.start_s)), s.label
        )
        for s in found
        if s.label != "tracking"
    ]


def _key_to_trouble(figure: Any, result: RunResult) -> None:
    from matplotlib.patches import Patch

    seen = {e["status"] for e in result.events if e["event"] == "tracking"}
    keys = [
        Patch(facecolor="none", edgecolor=look.INK, hatch=hatch, label=status)
        for status, hatch in (("degraded", "////"), ("lost", "xxxx"))
        if status in seen
    ]
    if keys:
        figure.legend(handles=keys, loc="outside lower right", ncols=2, fontsize=10, frameon=False)


def _leave_room(axes: Any) -> None:
    """Raise the upper limit, so that curves stay clear of the names at the top."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.12 * (high - low))


def _legend_below(figure: Any, axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=11, frameon=False)
