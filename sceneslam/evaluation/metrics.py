"""The numbers of a run: `metrics.json`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import (
    absolute_errors,
    relative_errors,
    root_mean_square,
    rotation_rmse_rad,
)
from sceneslam.evaluation.association import clip
from sceneslam.evaluation.comparison import compare
from sceneslam.evaluation.correctness import correct_rate_observed
from sceneslam.evaluation.detection import score_detection
from sceneslam.evaluation.gaps import why_bridged, why_without_pose
from sceneslam.evaluation.path import length_ratio, segment_errors
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.evaluation.shortfalls import shortfalls
from sceneslam.evaluation.switches import count_false, list_switches
from sceneslam.types.files import replacing
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

Metrics = dict[str, Any]


def evaluate(
    result: RunResult,
    truth: GroundTruth | None,
    *,
    settings: EvaluationSettings,
    peak_rss_mb: float | None = None,
    reference: Trajectory | None = None,
) -> Metrics:
    """Return all metrics of a run; unknown ones (e.g. without ground truth) are None.

    `reference` is another run's trajectory over the same path, not aligned unless one map begins
    later. `notes` are sentences on why an expected number is missing; `shortfalls` are sentences on
    why the run is incomplete, which makes the exit code 1.
    """
    switches = list_switches(result, truth, settings.scenes)
    detected = {str(e["scene"]) for e in result.events if e["event"] == "scene"}
    accuracy = _accuracy(result, truth, settings)
    metrics: Metrics = {
        **accuracy,
        "coverage": coverage(result),
        "switches": switches,
        "false_switches": count_false(switches, truth, detected, settings.scenes),
        "detection": _detection(result, truth, settings),
        **_extent(result),
        **_costs(result),
        "modules": _per_module(result),
        "bridged": sum(module == "" for module in result.modules),
        "bridged_why": why_bridged(result),
        "missing_why": why_without_pose(result),
        "peak_rss_mb": peak_rss_mb,
        "faults": [str(e["what"]) for e in result.events if e["event"] == "fault"],
        "notes": _notes(result, truth, accuracy),
        "warnings": [str(e["what"]) for e in result.events if e["event"] == "warning"],
        "shortfalls": shortfalls(result, settings.coverage_min_ratio),
    }
    if reference is not None:
        difference = compare(result.trajectory, reference, settings.association_gap_s)
        metrics["reference"] = {
            "max_difference_m": difference.max_m,
            "rms_difference_m": difference.rms_m,
            "matched": len(difference.differences_m),
        }
    return dict(_plain(metrics))


def write_metrics(path: Path, metrics: Metrics) -> None:
    """Write the metrics as standard JSON (no NaN)."""
    with replacing(path) as file:
        file.write(json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def truth_of_run(result: RunResult, truth: GroundTruth | None) -> GroundTruth | None:
    """Return the truth without poses outside the run's time span, which are not used.

    The last pose before it and the first after it stay, and all scenes.
    """
    observed_ns = result.observed_ns
    if truth is None or not len(observed_ns):
        return truth
    return replace(
        truth, trajectory=clip(truth.trajectory, int(observed_ns[0]), int(observed_ns[-1]))
    )


def coverage(result: RunResult) -> float | None:
    """Return the share of observations, from the first pose on, that got a pose."""
    if not len(result.observed_ns):
        return None
    if not len(result.trajectory):
        return 0.0
    observed_ns = result.observed_ns[result.observed_ns >= result.trajectory.stamps_ns[0]]
    if not len(observed_ns):
        return 0.0
    return float(np.isin(observed_ns, result.trajectory.stamps_ns).mean())


def _accuracy(
    result: RunResult, truth: GroundTruth | None, settings: EvaluationSettings
) -> Metrics:
    known = truth_of_run(result, truth)
    true = known.trajectory if known else Trajectory.empty()
    estimate, gap_s = result.trajectory, settings.association_gap_s
    absolute = absolute_errors(estimate, true, gap_s)
    relative = relative_errors(estimate, true, gap_s, settings.rpe_interval_s)
    segments = segment_errors(estimate, true, gap_s, settings.segment_m)
    return {
        "ate_rmse_m": absolute.rmse_m,
        "ate_max_m": absolute.max_m,
        "ate_online_m": absolute_errors(result.online, true, gap_s).rmse_m,
        "ate_rot_rad": rotation_rmse_rad(estimate, true, gap_s),
        "rpe_trans_m": root_mean_square(relative.trans_m),
        "rpe_rot_rad": root_mean_square(relative.rot_rad),
        "rpe_interval_s": settings.rpe_interval_s,
        "segment_m": settings.segment_m,
        "segment_trans_m": root_mean_square(segments.trans_m),
        "segment_rot_rad": root_mean_square(segments.rot_rad),
        "length_ratio": length_ratio(estimate, true, gap_s),
        "correct_rate": correct_rate_observed(estimate, true, result.observed_ns, settings.limits),
        "truth_matched": len(absolute.errors_m),
        "association_gap_s": gap_s,
    }


def _detection(
    result: RunResult, truth: GroundTruth | None, settings: EvaluationSettings
) -> Metrics:
    confirmed = [event for event in result.events if event["event"] == "scene"]
    end_ns = int(result.observed_ns[-1]) if len(result.observed_ns) else 0
    return score_detection(confirmed, truth, end_ns, settings.scenes)


def _extent(result: RunResult) -> Metrics:
    observed_ns = result.observed_ns
    duration_s = float(observed_ns[-1] - observed_ns[0]) * 1e-9 if len(observed_ns) else 0.0
    steps_m = np.linalg.norm(np.diff(result.trajectory.positions_m, axis=0), axis=1)
    wall_s = result.timings.wall_s
    return {
        "observations": len(observed_ns),
        "dropped": result.dropped,
        "dropped_images": result.dropped_images,
        "poses": len(result.trajectory),
        "start_ns": int(observed_ns[0]) if len(observed_ns) else None,
        "duration_s": duration_s,
        "path_length_m": float(steps_m.sum()),
        "realtime_factor": duration_s / wall_s if wall_s > 0 else None,
    }


def _costs(result: RunResult) -> Metrics:
    return {
        "bus_overhead_us": _median_p95(result.timings.bus_us),
        "detector_us": _median_p95(result.timings.detector_us),
        "latency_ms": _percentiles(result.timings.latency_ms, p50=50, p99=99),
        "slowest": [asdict(pose) for pose in result.timings.slowest],
    }


def _per_module(result: RunResult) -> Metrics:
    named = [module for module in result.modules if module]
    keys = sorted({*named, *result.timings.module_ms})
    total = max(len(result.modules), 1)
    return {
        key: {
            "frame_ms": _median_p95(result.timings.module_ms.get(key, np.zeros(0))),
            "poses": named.count(key),
            "share": named.count(key) / total,
        }
        for key in keys
    }


def _median_p95(values: NDArray[np.float64]) -> Metrics:
    return _percentiles(values, median=50, p95=95)


def _percentiles(values: NDArray[np.float64], **percents: float) -> Metrics:
    """Return the percentiles by name; None of an empty array."""
    known = len(values) > 0
    return {
        name: float(np.percentile(values, percent)) if known else None
        for name, percent in percents.items()
    }


def _notes(result: RunResult, truth: GroundTruth | None, accuracy: Metrics) -> list[str]:
    estimate = result.trajectory
    if truth is None or not len(truth.trajectory) or not len(estimate):
        return []
    if accuracy["truth_matched"]:
        return []
    return [
        "no pose could be held against the ground truth: "
        f"trajectory {_span(estimate)}, ground truth {_span(truth.trajectory)}, "
        f"association_gap_s {accuracy['association_gap_s']:g}"
    ]


def _span(trajectory: Trajectory) -> str:
    first_s, last_s = trajectory.stamps_ns[[0, -1]] * 1e-9
    return f"{first_s:.3f} s to {last_s:.3f} s"


def _plain(value: Any) -> Any:
    """Return a value for JSON: plain numbers, and None for NaN and infinity."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
