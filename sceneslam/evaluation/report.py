"""One HTML file that tells how a run went and opens alone."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from sceneslam.evaluation.figures import write_figures
from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.story import tell
from sceneslam.evaluation.summary import degrees, number, percent, seconds
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_SHOWN_FAULTS = 20
_CAPTIONS = {
    "grey_mean": "What the detector measured. Shading: the true scene, where it is known; "
    "dash-dotted: the instant at which a change of scene was confirmed.",
    "map": "The map from above: occupancy grid in grey, points and trajectory in the colour of "
    "the module that gave them, ground truth dashed.",
    "timeline": "Which module gave the poses, and when it was in trouble.",
    "error": "Distance from the true position after one rigid alignment of the whole trajectory.",
    "difference": "Distance from the reference run over the same path, without any alignment.",
}


def write_report(
    folder: Path,
    result: RunResult,
    truth: GroundTruth | None,
    metrics: Metrics,
    *,
    threshold: float | None,
    config_yaml: str,
    versions: Mapping[str, str],
    faults: Sequence[str],
    reference: Trajectory | None = None,
    value_label: str = "detector value",
) -> Path:
    """Write `figures/*.png` and `report.html` into the run's folder; return the report's path.

    `threshold` is drawn with the detector's values, `faults` are sentences about the input.
    """
    images = write_figures(
        folder / "figures",
        result,
        truth,
        threshold=threshold,
        value_label=value_label,
        reference=reference,
        association_gap_s=metrics["association_gap_s"],
    )
    told = {
        **_told(metrics),
        "faults": _faults([*faults, *metrics["faults"], *metrics["notes"]]),
        "figures": "".join(_figure(image) for image in images),
        "versions": _table(["part", "version"], [[*item] for item in versions.items()]),
        "config": escape(config_yaml),
    }
    page = files("sceneslam.evaluation").joinpath("report.html").read_text("utf-8")
    path = folder / "report.html"
    path.write_text(Template(page).substitute(told), encoding="utf-8")
    return path


def _told(metrics: Metrics) -> dict[str, str]:
    """Return the parts of the page that say what the metrics say."""
    return {
        "story": "".join(f"<p>{escape(paragraph)}</p>\n" for paragraph in tell(metrics)),
        "numbers": _numbers(metrics),
        "switches": _switches(metrics),
        "modules": _modules(metrics),
        "metrics": escape(json.dumps(metrics, indent=2)),
    }


def _numbers(metrics: Metrics) -> str:
    bus, detector = metrics["bus_overhead_us"], metrics["detector_us"]
    entries = {
        "coverage": percent(metrics["coverage"]),
        "ATE (RMSE)": number(metrics["ate_rmse_m"], 4, " m"),
        "largest error": number(metrics["ate_max_m"], 3, " m"),
        "RPE over 1 s": number(metrics["rpe_trans_m"], 4, " m"),
        "RPE over 1 s, rotation": degrees(metrics["rpe_rot_rad"]),
        "Correct Rate": percent(metrics["correct_rate"]),
        "switches": str(len(metrics["switches"])),
        "false switches": number(metrics["false_switches"], 0),
        "speed, times real time": number(metrics["realtime_factor"], 2, " ×"),
        "bus, median per observation": number(bus["median"], 0, " µs"),
        "detector, median": number(detector["median"], 0, " µs"),
        "peak memory": number(metrics["peak_rss_mb"], 0, " MB"),
    }
    if "reference" in metrics:
        largest_m = metrics["reference"]["max_difference_m"]
        entries["largest difference from the reference"] = number(largest_m, 3, " m")
    known = {name: value for name, value in entries.items() if value != "–"}
    return "".join(
        f"<li><b>{escape(value)}</b><span>{escape(name)}</span></li>"
        for name, value in known.items()
    )


def _faults(faults: Sequence[str]) -> str:
    if not faults:
        return ""
    sentences = list(dict.fromkeys(faults))  # each once, in order
    shown = sentences[:_SHOWN_FAULTS]
    if len(sentences) > len(shown):
        shown.append(f"and {len(sentences) - len(shown)} more (see events.jsonl)")
    items = "".join(f"<li>{escape(fault)}</li>" for fault in shown)
    return f'<h2>Faults</h2><div class="faults"><ul>{items}</ul></div>'


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
            number(switch["jump_m"], 4, " m"),
            degrees(switch["jump_rad"]),
            number(switch["cost_ms"], 1, " ms"),
        ]
        for switch in metrics["switches"]
    ]
    note = "Delay: from the true change. Jump and turn: error of the motion across the hand-over."
    return _table(heads, rows) + f'<p class="muted">{note}</p>'


def _modules(metrics: Metrics) -> str:
    rows = [
        [
            key,
            str(module["poses"]),
            percent(module["share"]),
            number(module["frame_ms"]["median"], 1, " ms"),
            number(module["frame_ms"]["p95"], 1, " ms"),
        ]
        for key, module in metrics["modules"].items()
    ]
    rows.append(["(bridged)", str(metrics["bridged"]), "", "", ""])
    return _table(["module", "poses", "share", "median per frame", "95 % within"], rows)


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows
    )
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


def _figure(image: Path) -> str:
    data = base64.b64encode(image.read_bytes()).decode("ascii")
    caption = escape(_CAPTIONS[image.stem])
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>\n"
    )
