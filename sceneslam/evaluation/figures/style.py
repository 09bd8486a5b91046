"""The style of all figures: size, colour-blind-safe colours, bands of time.

A figure is drawn once and written as PNG and as SVG. The SVG is also part of the report, where its
neutral colours are replaced by the page's, so that it follows light and dark mode.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.files import replacing
from sceneslam.types.run import RunResult
from sceneslam.types.truth import GroundTruth

# Okabe and Ito's palette, darkest first, without yellow, which is hardly visible on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BRIDGED = "#777777"
INK, MUTED, LINE, PAPER = "#222222", "#666666", "#DDDDDD", "#FFFFFF"
_STRETCHES = 900  # of a curve; the PNG has as many pixels
WIDTH_IN = 6.0  # small, so that 11 pt stay legible when a phone shrinks the figure
_NAME_PT = (7.0, 11.0)  # font sizes of names of stretches
_GLYPH = 0.62  # width of a letter, in font sizes
SCENE_TINTS = ("#FBF3D0", "#CFD6E4", "#DDEBDD", "#EFDCE6", "#E3E3E3")
_TINT_OF = {"Bright": SCENE_TINTS[0], "Dark": SCENE_TINTS[1]}
_PAGE_COLORS = {  # CSS variables of report.html
    **{INK: "--ink", "#000000": "--ink", MUTED: "--muted", LINE: "--line", PAPER: "--paper"},
    **{tint: f"--scene-{number}" for number, tint in enumerate(SCENE_TINTS)},
}


@dataclass(frozen=True, slots=True)
class LabelledSpan:
    """A stretch of time [s] with one label."""

    start_s: float
    end_s: float
    label: str


def new_figure(width_in: float = WIDTH_IN, height_in: float = 3.6) -> Any:
    """Return an empty figure that draws with Agg and leaves no global state behind."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor=PAPER)
    FigureCanvasAgg(figure)
    return figure


def style(axes: Any, *, x_label: str = "time [s]", y_label: str = "") -> None:
    """Give axes labels, sizes that are legible on a phone, and a light grid."""
    axes.set_xlabel(x_label, fontsize=12, color=INK)
    axes.set_ylabel(y_label, fontsize=12, color=INK)
    axes.tick_params(labelsize=11, colors=INK)
    axes.grid(visible=True, color=LINE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def save(figure: Any, path: Path) -> Path:
    """Write a PNG whose bytes depend on the data alone.

    A palette of 256 colours makes the file four times smaller without a visible difference.
    """
    from PIL import Image

    figure.set_dpi(150)
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[:, :, :3])
    palette = image.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    with replacing(path, "wb") as file:
        palette.save(file, format="PNG", optimize=True)
    return path


def save_svg(figure: Any, path: Path) -> str:
    """Write an SVG for papers and slides, its text as text; return the file's content."""
    from matplotlib import rc_context

    text = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": path.stem}):
        figure.savefig(text, format="svg", metadata={"Date": None})
    with replacing(path, encoding="utf-8") as file:
        file.write(text.getvalue())
    return text.getvalue()


def for_page(svg: str) -> str:
    """Return an SVG file as an element for an HTML page that has the colours' variables."""
    svg = re.sub(r"<(metadata|style).*?</\1>\s*", "", svg[svg.index("<svg") :], flags=re.S)
    svg = re.sub(r'^<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1">', svg)
    for color, variable in _PAGE_COLORS.items():
        svg = re.sub(color, f"var({variable})", svg, flags=re.I)
    svg = re.sub(r"<[^>]+>", _round, svg)
    return re.sub(r"font-family: [^;\"]*;? ?", "", svg)


def _round(tag: re.Match[str]) -> str:
    """Return a tag with hundredths of a point, which are finer than any screen."""
    return re.sub(r"(\.\d\d)\d+", r"\1", tag[0])


def module_colors(result: RunResult) -> dict[str, str]:
    """Return a colour for every module: in the map's order, then by first appearance."""
    tracking = [event["module"] for event in result.events if event["event"] == "tracking"]
    keys = dict.fromkeys([*result.map.modules, *(key for key in result.modules if key), *tracking])
    return {key: PALETTE[number % len(PALETTE)] for number, key in enumerate(keys)}


def scene_tints(scenes: Iterable[str]) -> dict[str, str]:
    """Return a background tint for every scene."""
    others = [scene for scene in dict.fromkeys(scenes) if scene not in _TINT_OF]
    spare = SCENE_TINTS[2:]
    return {**_TINT_OF, **{scene: spare[n % len(spare)] for n, scene in enumerate(others)}}


def elapsed_s(result: RunResult, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return stamps (N,) as seconds since the first observation."""
    origin_ns = result.observed_ns[0] if len(result.observed_ns) else np.int64(0)
    return np.asarray((stamps_ns - origin_ns) * 1e-9)


def thinned(
    times_s: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a curve (N,) as the minima and maxima (M,) of equal intervals, for faster drawing."""
    if len(values) <= 2 * _STRETCHES:
        return times_s, values
    starts = np.linspace(0, len(values), _STRETCHES, endpoint=False).astype(int)
    ends = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return np.repeat(times_s[starts], 2), np.column_stack(ends).ravel()


def duration_s(result: RunResult) -> float:
    """Return the time from the first to the last observation [s]."""
    return float(elapsed_s(result, result.observed_ns[-1:]).sum())


def spans(times_s: NDArray[np.float64], labels: Sequence[str], end_s: float) -> list[LabelledSpan]:
    """Return the time spans of equal labels at times (N,); each lasts until the next begins."""
    if not len(labels):
        return []
    names = np.array(labels, dtype=object)
    starts = np.flatnonzero(np.append(True, names[1:] != names[:-1]))
    ends_s = np.append(times_s[starts[1:]], max(end_s, times_s[-1]))
    return [
        LabelledSpan(float(times_s[start]), float(stop_s), str(names[start]))
        for start, stop_s in zip(starts, ends_s, strict=True)
    ]


def module_spans(result: RunResult) -> list[LabelledSpan]:
    """Return the spans of the modules that gave the poses; "" for bridged poses."""
    times_s = elapsed_s(result, result.trajectory.stamps_ns)
    return spans(times_s, result.modules, duration_s(result))


def true_scene_spans(result: RunResult, truth: GroundTruth | None) -> list[LabelledSpan]:
    """Return the true scenes within the run."""
    changes = truth.scenes if truth else ()
    stamps_ns = np.array([change.stamp_ns for change in changes], np.int64)
    found = spans(
        elapsed_s(result, stamps_ns), [change.scene for change in changes], duration_s(result)
    )
    return within(found, duration_s(result))


def within(found: Sequence[LabelledSpan], end_s: float) -> list[LabelledSpan]:
    """Return the parts of the spans that lie between 0 and `end_s`."""
    cut = [LabelledSpan(max(s.start_s, 0.0), min(s.end_s, end_s), s.label) for s in found]
    return [span for span in cut if span.end_s > span.start_s]


def draw_bands(
    axes: Any, bands: Sequence[LabelledSpan], colors: dict[str, str], alpha: float
) -> None:
    """Shade stretches of time and name each at the top where there is room for it."""
    total_s = max((band.end_s for band in bands), default=0.0)
    for band in bands:
        color = colors.get(band.label, BRIDGED)
        axes.axvspan(band.start_s, band.end_s, color=color, alpha=alpha, linewidth=0, zorder=0)
        share = (band.end_s - band.start_s) / max(total_s, 1e-9)
        name, size = fitted(axes, band.label or "bridged", share)
        if size:
            centre_s = 0.5 * (band.start_s + band.end_s)
            axes.text(
                centre_s,
                0.985,
                name,
                transform=axes.get_xaxis_transform(),
                ha="center",
                va="top",
                fontsize=size,
                color=INK,
            )


def fitted(axes: Any, name: str, share: float) -> tuple[str, float]:
    """Return a name as it fits into a share of the width, in two lines at need, and its font size.

    The size is 0 where there is no room.
    """
    width_pt = share * axes.get_window_extent().width * 72.0 / axes.figure.dpi
    broken = re.sub(r"(?<=[a-z])(?=[A-Z])| ", "\n", name, count=1)
    sizes = {
        text: width_pt / (_GLYPH * (1 + max(map(len, text.split("\n"))))) for text in (name, broken)
    }
    text = name if sizes[name] >= _NAME_PT[0] else broken
    return text, min(_NAME_PT[1], sizes[text]) if sizes[text] >= _NAME_PT[0] else 0.0
