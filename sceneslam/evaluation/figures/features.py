"""The detector's features over time, with the limits of its rules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sceneslam.evaluation.figures import style as look
from sceneslam.types.run import RunResult
from sceneslam.types.truth import GroundTruth

_HEIGHT_IN = 1.1  # per curve
Limits = Mapping[str, Sequence[float]]  # feature -> limits in its rules


def feature_limits(detector: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the limits in a detector's configuration; empty without rules."""
    values = detector.get("values") or {}
    found: dict[str, set[float]] = {}
    for rule in (detector.get("rules") or {}).values():
        for name, limits in ((rule or {}).get("when") or {}).items():
            numbers = [values.get(limit, limit) for limit in limits if limit is not None]
            found.setdefault(name, set()).update(map(float, numbers))
    return {name: sorted(numbers) for name, numbers in found.items()}


def draw_features(result: RunResult, truth: GroundTruth | None, limits: Limits) -> Any:
    """Return a curve per feature with a rule, None if the votes contain no features."""
    votes = [event for event in result.events if event["event"] == "vote" and "features" in event]
    names = [name for name in (votes[0]["features"] if votes else ()) if name in limits]
    if not names:
        return None
    times_s = look.elapsed_s(result, np.array([e["stamp_ns"] for e in votes], np.int64))
    figure = look.new_figure(look.WIDTH_IN, 0.8 + _HEIGHT_IN * len(names))
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    bands = look.true_scene_spans(result, truth)
    for axes, name in zip(rows, names, strict=True):
        values = np.array([event["features"][name] for event in votes], dtype=float)
        look.draw_bands(axes, bands, look.scene_tints(b.label for b in bands), 0.9)
        axes.plot(*look.thinned(times_s, values), color=look.PALETTE[0], linewidth=1.2)
        for limit in limits[name]:
            axes.axhline(limit, color=look.PALETTE[1], linestyle="--", linewidth=1.2)
        look.style(axes, x_label="time [s]" if axes is rows[-1] else "")
        axes.set_title(
            f"{name}  (limits: {', '.join(f'{limit:g}' for limit in limits[name])})",
            loc="left",
            fontsize=10,
        )
        axes.set_xlim(0.0, max(look.duration_s(result), 1e-3))
    return figure
