"""One HTML file with everything about a run, which opens without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from sceneslam.evaluation.figures.features import feature_limits
from sceneslam.evaluation.figures.run_figures import write_figures
from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.names import module_names, renamed
from sceneslam.evaluation.report import markup
from sceneslam.evaluation.report.answer import Answer, answer
from sceneslam.evaluation.report.chronicle import Entry, chronicle
from sceneslam.evaluation.report.moments import pictures
from sceneslam.evaluation.report.page import fill_page
from sceneslam.evaluation.report.story import tell
from sceneslam.evaluation.report.summary import degrees, jump, number, percent, seconds
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_SHOWN_FAULTS, _SHOWN_ENTRIES = 20, 80
_CAPTIONS = {
    "map": "The map from above: occupancy grid in grey, points and trajectory in the colour of "
    "the module that gave them, ground truth dashed.",
    "path": "The same map, zoomed in on the path.",
    "view": "The map in third-person view, with the path. Points have the camera's colour, "
    "or without a camera that of their module.",
    "timeline": "The active module over time. Hatched: degraded, it tracks with weak constraints "
    "and a large covariance; crossed: lost, it has no pose.",
    "grey_mean": "The detector's value. Shading: the true scene, where it is known; "
    "dash-dotted: the instant at which a change of scene was confirmed.",
    "features": "The features of the rules, and their limits (dashed): a good limit separates the "
    "values of one scene from those of the others. Shading as above.",
    "posterior": "The probability of each scene by the votes so far. Shading and lines as above.",
    "error": "Distance from the true position after one rigid alignment of the whole trajectory. "
    "Shading: the active module; dash-dotted: a change of module.",
    "error_path": "The path from above, coloured by the distance from the true position.",
    "pose": "Position and heading in the frame map over time.",
    "difference": "Distance from the reference run over the same path, without alignment; a map "
    "that begins later is laid on the other at the first pose that both have.",
}


def write_report(
    folder: Path,
    result: RunResult,
    truth: GroundTruth | None,
    metrics: Metrics,
    *,
    title: str,
    config: Mapping[str, Any],
    config_yaml: str,
    threshold: float | None,
    versions: Mapping[str, str],
    faults: list[str],
    reference: Trajectory | None = None,
    value_label: str = "detector value",
) -> Path:
    """Write `figures/` (PNG and SVG) and `report.html` into the run's folder; return its path.

    `threshold` is drawn with the detector's values. `faults` are sentences about the run; sentences
    on figures that could not be drawn are added to it.
    """
    named = renamed(result, module_names(config.get("slam") or {}))
    figures = write_figures(
        folder / "figures",
        named,
        truth,
        threshold=threshold,
        limits=feature_limits(config.get("detector") or {}),
        value_label=value_label,
        reference=reference,
        association_gap_s=metrics["association_gap_s"],
        faults=faults,
    )
    entries = chronicle(result, metrics["switches"], value_label=value_label)
    values = {
        **_told(metrics),
        "answer": _answer(_answered(result, metrics, faults, config)),
        "title": escape(_titled(title, config)),
        "made_of": markup.bullets(_made_of(config)),
        "faults": _faults(_amiss(metrics)),
        "figures": "".join(markup.figure(f.svg, _CAPTIONS[f.name]) for f in figures),
        "moments": _seen(named),
        "chronicle": _chronicle(entries),
        "modules": _modules(metrics, config.get("slam") or {}),
        "versions": markup.table(["part", "version"], [[*item] for item in versions.items()]),
        "config": escape(config_yaml),
    }
    return fill_page(folder / "report.html", "sceneslam.evaluation.report", "run_page.html", values)


def _answered(
    result: RunResult, metrics: Metrics, faults: Sequence[str], config: Mapping[str, Any]
) -> Answer:
    stamps_ns = result.trajectory.stamps_ns
    first_pose_s = seconds(metrics, int(stamps_ns[0])) if len(stamps_ns) else 0.0
    return answer(metrics, faults, config.get("source") or (), first_pose_s=first_pose_s)


def _seen(result: RunResult) -> str:
    """Return the camera images at changes, under a heading."""
    start_ns = int(result.observed_ns[0]) if len(result.observed_ns) else 0
    images = pictures(result.moments, start_ns)
    return f"<h2>Camera images at changes</h2>{images}" if images else ""


def _told(metrics: Metrics) -> dict[str, str]:
    """Return the parts of the page that present the metrics."""
    return {
        "story": markup.paragraphs(tell(metrics)),
        "numbers": _numbers(metrics),
        "switches": _switches(metrics),
        "metrics": escape(json.dumps(metrics, indent=2)),
    }


def _titled(title: str, config: Mapping[str, Any]) -> str:
    """Return the title with the name of the recording, to distinguish pages."""
    path = (config.get("source") or {}).get("path")
    return f"{title} · {Path(path).name}" if path else title


def _made_of(config: Mapping[str, Any]) -> list[str]:
    """Return the components of the run, one line each."""
    source = config.get("source") or {}
    given = [str(source[key]) for key in ("path", "story") if source.get(key)]
    parts = {
        "source": " ".join([_kind(source), *given]),
        "effects": _kind(config.get("effects") or {}),
    }
    scenes = config.get("scenes") or {}
    if len(scenes) > 1:  # else there is nothing to choose
        parts |= _chosen_by(config, scenes)
    lines = [f"{name}: {value}" for name, value in parts.items() if value]
    modules = (config.get("slam") or {}).items()
    return [*lines, *(f"“{key}”: {_kind(node)}" for key, node in modules if node)]


def _chosen_by(config: Mapping[str, Any], scenes: Mapping[str, Sequence[str]]) -> dict[str, str]:
    detector = config.get("detector") or {}
    return {
        "detector": _kind(detector) + _plain_values(detector),
        "hand-over": str((config.get("policy") or {}).get("handover", "")),
        "scenes": "; ".join(f"{name} → {', then '.join(keys)}" for name, keys in scenes.items()),
    }


def _kind(node: Mapping[str, Any]) -> str:
    return str(node.get("_target_", "")).rpartition(".")[2]


def _plain_values(node: Mapping[str, Any]) -> str:
    """Return a component's numeric settings, which matter most."""
    parts = [f"{key} {value:g}" for key, value in node.items() if isinstance(value, float)]
    return f" ({', '.join(parts)})" if parts else ""


def _numbers(metrics: Metrics) -> str:
    online_m = metrics["ate_online_m"]
    over = f"over {metrics['rpe_interval_s']:g} s"
    entries = {
        "position error, root mean square (ATE)": number(metrics["ate_rmse_m"], 4, " m"),
        "the same, as reported online": number(online_m, 4, " m"),
        "largest error": number(metrics["ate_max_m"], 3, " m"),
        "rotation error, root mean square": degrees(metrics["ate_rot_rad"]),
        f"error over {metrics['segment_m']:g} m of path": number(
            metrics["segment_trans_m"], 3, " m"
        ),
        "estimated over true length": number(metrics["length_ratio"], 4),
        f"error of the motion {over}": number(metrics["rpe_trans_m"], 4, " m"),
        f"turn's error {over}": degrees(metrics["rpe_rot_rad"]),
        "of the time correct": percent(metrics["correct_rate"]),
        "of observations from the first pose on with a pose": percent(metrics["coverage"]),
        "switches": str(len(metrics["switches"])),
        "false switches": number(metrics["false_switches"], 0),
        "speed, times real time": number(metrics["realtime_factor"], 2, " ×"),
        "peak memory": number(metrics["peak_rss_mb"], 0, " MB"),
    }
    if "reference" in metrics:
        largest_m = metrics["reference"]["max_difference_m"]
        entries["largest difference from the reference"] = number(largest_m, 3, " m")
    return markup.tiles(entries)


def _answer(answer: Answer) -> str:
    """Return whether it worked, where not and why, and what to change."""
    advice = f"<p><b>What to change</b></p>{markup.bullets(answer.advice)}" if answer.advice else ""
    where = _listed(answer.where) if answer.where else ""
    headline = f"<p><b>{escape(answer.headline)}</b></p>"
    return f'<div class="answer {answer.kind}">{headline}{where}{advice}</div>'


def _amiss(metrics: Metrics) -> list[str]:
    """Return further problems, the most important first."""
    kinds = ("warnings", "faults", "notes")
    return [sentence for kind in kinds for sentence in metrics[kind]]


def _faults(faults: Sequence[str]) -> str:
    if not faults:
        return ""
    return f'<h2>Faults</h2><div class="faults">{_listed(faults)}</div>'


def _listed(sentences: Sequence[str]) -> str:
    """Return a list of sentences, each once, and how many more there are."""
    known = list(dict.fromkeys(sentences))
    shown = known[:_SHOWN_FAULTS]
    if len(known) > len(shown):
        shown.append(f"and {len(known) - len(shown)} more (see events.jsonl)")
    return markup.bullets(shown)


def _chronicle(entries: Sequence[Entry]) -> str:
    if not entries:
        return '<p class="muted">Nothing happened.</p>'
    weighty = [entry for entry in entries if entry.kind != "trouble"]
    shown = (entries if len(entries) <= _SHOWN_ENTRIES else weighty)[:_SHOWN_ENTRIES]
    items = "".join(
        f'<li class="{entry.kind}"><time>{entry.at_s:.2f} s</time><div><b>{escape(entry.what)}</b>'
        f"<p>{escape(' '.join(entry.details))}</p></div></li>"
        for entry in shown
    )
    left = len(entries) - len(shown)
    more = f'<p class="muted">And {left} more in events.jsonl.</p>' if left else ""
    return f'<ol class="chronicle">{items}</ol>{more}'


def _switches(metrics: Metrics) -> str:
    if not metrics["switches"]:
        return '<p class="muted">No module was replaced.</p>'
    heads = ["when", "why", "scene", "from", "to", "delay", "gap", "jump", "turn", "cost"]
    rows = [
        [
            number(seconds(metrics, switch["stamp_ns"]), 2, " s"),
            switch["reason"],
            switch["scene"],
            switch["from"],
            switch["to"],
            number(switch["confirm_delay_s"], 2, " s"),
            number(switch["gap_s"], 2, " s"),
            *_jump(switch),
            number(switch["cost_ms"], 1, " ms"),
        ]
        for switch in metrics["switches"]
    ]
    note = (
        "Delay: from the true change. Jump and turn: error of the motion across the hand-over; "
        "without ground truth, how far it moved the current pose (“moved”)."
    )
    return markup.table(heads, rows) + f'<p class="muted">{note}</p>'


def _jump(switch: Mapping[str, Any]) -> list[str]:
    """Return the cells of the columns jump and turn."""
    if not jump(switch, 4):
        return [number(None), number(None)]
    moved = "" if switch["jump_is_error"] else "moved "
    return [moved + number(switch["jump_m"], 4, " m"), moved + degrees(switch["jump_rad"])]


def _modules(metrics: Metrics, slam: Mapping[str, Any]) -> str:
    """Return the cost per observation of every part, and the poses per module."""
    rows = [
        [
            key,
            _kind(slam.get(key) or {}),
            str(module["poses"]),
            percent(module["share"]),
            number(module["frame_ms"]["median"], 1, " ms"),
            number(module["frame_ms"]["p95"], 1, " ms"),
        ]
        for key, module in metrics["modules"].items()
    ]
    if metrics["bridged"]:
        share = percent(metrics["bridged"] / max(metrics["poses"], 1))
        rows.append(["(bridged)", "", str(metrics["bridged"]), share, "", ""])
    for name, key in (("(detector)", "detector_us"), ("(bus)", "bus_overhead_us")):
        spent = [number(metrics[key][at], 2, " ms", 1e-3) for at in ("median", "p95")]
        rows.append([name, "", "", "", *spent])
    return markup.table(["module", "kind", "poses", "share", "median per frame", "95 %"], rows)
