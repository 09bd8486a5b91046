"""Charts of a sweep: error, delay and false switches over every swept number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby

from sceneslam.collect.chart import Line, Point, draw_front, draw_lines, front
from sceneslam.collect.rows import Row, Value
from sceneslam.collect.summary import SEED, Group, mean_of
from sceneslam.evaluation.figures.style import PALETTE
from sceneslam.evaluation.report.markup import figure

_SHOWN = {  # metric -> name of the axis
    "ate_rmse_m": "ATE RMSE [m]",
    "detection.delay_s": "detection delay [s]",
    "detection.false": "false detections",
    "detection.missed": "missed changes",
}
_RECORDING = (
    "story",
    "scenario",
    "source",
    "effects",
    "lights",
)  # keys that select the recording
_BEST_MAX = 8  # points of the front in the caption
_LINES_MAX = len(PALETTE)  # distinguishable colours
_POINTS_MAX = 600


def charts(groups: Sequence[Group]) -> Iterator[str]:
    """Yield the charts as SVG, each with its caption."""
    weighed = _front(groups)
    if weighed:
        yield weighed
    numeric = [key for key in groups[0].keys if _is_numeric(groups, key)]
    for key in numeric:
        for metric, name in _SHOWN.items():
            lines = list(_lines(groups, key, metric))
            if len({point.y for line in lines for point in line.points}) > 1:
                other = _other(groups, key) or ""
                drawn = draw_lines(lines, x_label=key, y_label=name, key=other)
                yield figure(drawn, _caption(groups, key, name))


def _front(groups: Sequence[Group]) -> str:
    points, settings = [], _settings(groups)
    falses = [group.mean("detection.false") for group in settings]
    most = max((false.count for false in falses if false), default=0)
    for group, false in zip(settings, falses, strict=True):
        delay, missed = group.mean("detection.delay_s"), group.mean("detection.missed")
        # A setting that failed on a recording is not compared.
        if delay and false and false.count == most and not (missed and missed.mean):
            label = ", ".join(f"{key}={value}" for key, value in group.keys.items())
            points.append(Point(x=delay.mean, y=false.mean, label=label))
    if len({point.y for point in points}) < 2:  # no trade-off with the delay
        return ""
    drawn = draw_front(
        points, x_label=_SHOWN["detection.delay_s"], y_label=_SHOWN["detection.false"]
    )
    best = list(map(_alike, _twins(front(points))))
    return figure(
        drawn,
        "Every setting that ran wherever others did and found all true changes: how late it found "
        "them, and how many false ones it found, on average over recordings. The line is "
        "the Pareto front: "
        f"{'; '.join(best[:_BEST_MAX])}{'; ...' if len(best) > _BEST_MAX else '.'}",
    )


def _twins(best: Sequence[Point]) -> Iterator[Sequence[Point]]:
    """Yield groups of points of a front with equal x and y."""
    for _, twins in groupby(best, key=lambda point: (point.x, point.y)):
        yield list(twins)


def _alike(twins: Sequence[Point]) -> str:
    """Return a text on settings with equal results; the middle one is named."""
    one = twins[len(twins) // 2]
    others = f" (as {len(twins) - 1} others)" if len(twins) > 1 else ""
    return f"{one.label}{others}: {one.x:.3g} s, {one.y:.3g} false"


def _settings(groups: Sequence[Group]) -> list[Group]:
    """Return the groups by setting, averaged over recordings."""
    found: dict[tuple[tuple[str, Value], ...], list[Row]] = {}
    for group in groups:
        keys = tuple(one for one in group.keys.items() if not one[0].startswith(_RECORDING))
        found.setdefault(keys, []).extend(group.rows)
    return [Group(keys=dict(keys), rows=rows) for keys, rows in found.items()]


def _lines(groups: Sequence[Group], key: str, metric: str) -> Iterator[Line]:
    """Yield a line per value of the other key, averaged over everything else."""
    other = _other(groups, key)
    values = _few(_values(groups, other)) if other else [None]
    for value, color in zip(values, PALETTE, strict=False):
        chosen = [group for group in groups if other is None or group.keys[other] == value]
        points = [_point(chosen, key, x, metric) for x in _values(chosen, key)]
        known = [point for point in points if point is not None]
        if known:
            yield Line(name=str(value), color=color, points=sorted(known, key=lambda p: p.x))


def _point(groups: Sequence[Group], key: str, x: Value, metric: str) -> Point | None:
    """Return the mean over the groups, with its interval if they differ by the seed only."""
    at = [group for group in groups if group.keys[key] == x]
    numbers = [row.metrics.get(metric) for group in at for row in group.rows]
    mean = mean_of([float(y) for y in numbers if isinstance(y, int | float)])
    if mean is None or not isinstance(x, int | float):
        return None
    half_width = mean.half_width if len(at) == 1 else None
    label = f"{x:g}: {mean.mean:.4g}"
    if half_width is not None:
        label += f" ± {half_width:.2g} ({mean.count} runs)"
    return Point(x=float(x), y=mean.mean, half_width=half_width, label=label)


def _caption(groups: Sequence[Group], key: str, name: str) -> str:
    other = _other(groups, key)
    rest = [one for one in groups[0].keys if one not in (key, other)]
    has_seeds = any(len(group.rows) > 1 for group in groups)
    caption = f"{name[0].upper()}{name[1:]} against {key}"
    if other and len(_values(groups, other)) > _LINES_MAX:
        caption += f", for some values of {other}"
    if rest or has_seeds:
        caption += f"; mean over {', '.join([*rest, *([SEED] if has_seeds else [])])}"
    if has_seeds and not rest:
        caption += ", bars: its 95 % confidence interval"
    return f"{caption}."


def _other(groups: Sequence[Group], key: str) -> str | None:
    """Return the other key with the most values, preferably not more than there are colours."""
    counts = {name: len(_values(groups, name)) for name in groups[0].keys if name != key}
    few = {name: count for name, count in counts.items() if count <= _LINES_MAX}
    return max(few or counts, key=lambda name: counts[name], default=None)


def _few(values: Sequence[Value]) -> list[Value]:
    """Return at most as many values as there are colours, evenly from first to last."""
    if len(values) <= _LINES_MAX:
        return list(values)
    steps = [round(k * (len(values) - 1) / (_LINES_MAX - 1)) for k in range(_LINES_MAX)]
    return [values[step] for step in steps]


def _is_numeric(groups: Sequence[Group], key: str) -> bool:
    values = _values(groups, key)
    is_number = all(isinstance(value, int | float) for value in values)
    return is_number and 1 < len(values) <= _POINTS_MAX


def _values(groups: Sequence[Group], key: str) -> list[Value]:
    return list(dict.fromkeys(group.keys[key] for group in groups))
