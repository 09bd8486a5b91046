"""Charts as inline SVG, without scripts: lines with error bars, and a Pareto front."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

from sceneslam.evaluation.figures.style import PALETTE

_WIDTH, _HEIGHT = 480, 280
_DOTS_MAX = 30  # dots per line; more would hide it
_RIGHT, _TOP, _BOTTOM = 16, 14, 46  # of the axes [px]
_NAME, _DIGIT = 36, 9.5  # left of the axes: the name of y, and every digit of its numbers [px]


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A point of a chart; `label` is its tooltip."""

    x: float
    y: float
    half_width: float | None = None  # half width of the confidence interval of y
    label: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line through points, by rising x."""

    name: str
    color: str
    points: Sequence[Point]


def draw_lines(lines: Sequence[Line], *, x_label: str, y_label: str, key: str = "") -> str:
    """Return a chart of coloured lines, with a legend of their names under the title `key`."""
    axes = _Axes([point for line in lines for point in line.points])
    parts = [axes.frame(x_label, y_label)]
    for line in lines:
        color = line.color
        path = " ".join(f"{axes.x(p.x):.1f},{axes.y(p.y):.1f}" for p in line.points)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        parts += [_bar(axes, point, color) for point in line.points if point.half_width]
        if len(line.points) <= _DOTS_MAX:
            parts += [_dot(axes, point, color) for point in line.points]
    return _svg(parts) + _legend(lines, key)


def draw_front(points: Sequence[Point], *, x_label: str, y_label: str) -> str:
    """Return a chart of points with a line through the Pareto front."""
    axes = _Axes(points)
    best = front(points)
    path = " ".join(f"{axes.x(x):.1f},{axes.y(y):.1f}" for x, y in _steps(best))
    others = [point for point in points if point not in best]
    parts = [
        axes.frame(x_label, y_label),
        f'<polyline points="{path}" fill="none" stroke="{PALETTE[1]}" stroke-width="2"/>',
        *(_dot(axes, point, "#999999") for point in others),
        *(_dot(axes, point, PALETTE[1]) for point in best),
    ]
    return _svg(parts)


def front(points: Sequence[Point]) -> list[Point]:
    """Return the Pareto front of points in x and y (smaller is better), by rising x."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.x, point.y)):
        is_twin = bool(best) and (point.x, point.y) == (best[-1].x, best[-1].y)
        if not best or point.y < best[-1].y or is_twin:
            best.append(point)
    return best


class _Axes:
    """Scaling of values to pixels, and round numbers for the axes."""

    def __init__(self, points: Sequence[Point]) -> None:
        highs = [point.y + (point.half_width or 0.0) for point in points]
        self._xs = _ticks(min(p.x for p in points), max(p.x for p in points))
        self._ys = _ticks(min(0.0, min(p.y for p in points)), max(highs))
        self._left = _NAME + _DIGIT * max(len(f"{value:g}") for value in self._ys)

    def x(self, value: float) -> float:
        return self._left + _share(value, self._xs) * (_WIDTH - self._left - _RIGHT)

    def y(self, value: float) -> float:
        height = _HEIGHT - _TOP - _BOTTOM
        return _TOP + (1.0 - min(max(_share(value, self._ys), 0.0), 1.0)) * height

    def frame(self, x_label: str, y_label: str) -> str:
        """Return grid, numbers and labels."""
        low, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
        parts = [
            f'<line x1="{self._left}" x2="{right}" y1="{self.y(v):.1f}" y2="{self.y(v):.1f}" '
            f'class="grid"/><text x="{self._left - 8}" y="{self.y(v) + 5:.1f}" '
            f'text-anchor="end">{v:g}</text>'
            for v in self._ys
        ]
        parts += [
            f'<text x="{self.x(v):.1f}" y="{low + 19}" text-anchor="middle">{v:g}</text>'
            for v in self._xs
        ]
        parts.append(
            f'<text x="{(self._left + right) / 2}" y="{_HEIGHT - 6}" text-anchor="middle" '
            f'class="name">{escape(x_label)}</text>'
            f'<text transform="translate(14 {(_TOP + low) / 2}) rotate(-90)" '
            f'text-anchor="middle" class="name">{escape(y_label)}</text>'
        )
        return "".join(parts)


def _ticks(low: float, high: float) -> list[float]:
    """Return three to seven round numbers that enclose a range."""
    spread = (high - low) or abs(high) or 1.0
    step = 10.0 ** math.floor(math.log10(spread))
    step *= next(one for one in (0.2, 0.5, 1.0, 2.0) if spread / (step * one) <= 6.0)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 12) for k in range(first, max(last, first + 1) + 1)]


def _share(value: float, ticks: Sequence[float]) -> float:
    return (value - ticks[0]) / (ticks[-1] - ticks[0])


def _steps(best: Sequence[Point]) -> Iterator[tuple[float, float]]:
    """Yield the corners of the step line through a front."""
    for number, point in enumerate(best):
        if number:
            yield point.x, best[number - 1].y
        yield point.x, point.y


def _dot(axes: _Axes, point: Point, color: str) -> str:
    return (
        f'<circle cx="{axes.x(point.x):.1f}" cy="{axes.y(point.y):.1f}" r="4" fill="{color}">'
        f"<title>{escape(point.label)}</title></circle>"
    )


def _bar(axes: _Axes, point: Point, color: str) -> str:
    half = point.half_width or 0.0
    x, high, low = axes.x(point.x), axes.y(point.y + half), axes.y(point.y - half)
    return f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{high:.1f}" y2="{low:.1f}" stroke="{color}"/>'


def _svg(parts: Sequence[str]) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}">{"".join(parts)}</svg>'


def _legend(lines: Sequence[Line], key: str) -> str:
    if len(lines) < 2:
        return ""
    items = "".join(
        f'<li><i style="background:{line.color}"></i>{escape(line.name)}</li>' for line in lines
    )
    return f'<ul class="legend"><li>{escape(key)}</li>{items}</ul>'
