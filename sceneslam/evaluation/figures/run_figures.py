"""All figures of a run, written as PNG and SVG files; the report holds them as well."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.accuracy import AbsoluteErrors, absolute_errors
from sceneslam.evaluation.comparison import compare
from sceneslam.evaluation.figures import style as look
from sceneslam.evaluation.figures.features import Limits, draw_features
from sceneslam.evaluation.figures.map import draw_map, draw_path
from sceneslam.evaluation.figures.pose import draw_error_path, draw_pose
from sceneslam.evaluation.figures.time import draw_posterior, draw_series, draw_timeline, draw_votes
from sceneslam.evaluation.figures.view import draw_view
from sceneslam.types import se3
from sceneslam.types.errors import text_of
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_log = logging.getLogger(__name__)
_PAPER_DIFFERENCE_M = 0.10  # "less than 10 cm" between the switched and the unswitched run
_ONLINE_DIFFERS_M = 1e-3  # smaller differences between online and revised errors are not drawn


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn:
    """One figure; beside its PNG lies an SVG of the same name."""

    name: str
    png: Path
    svg: str  # an element for the report's page


def write_figures(
    folder: Path,
    result: RunResult,
    truth: GroundTruth | None,
    *,
    threshold: float | None,
    limits: Limits,
    association_gap_s: float,
    value_label: str = "detector value",
    reference: Trajectory | None = None,
    faults: list[str] | None = None,
) -> list[Drawn]:
    """Write all figures of a run; return them in the report's order.

    A figure that fails (e.g. out of memory) is left out, with a sentence in `faults`.

    `map`, `path` (where it is small in the map), `view` (with points), `timeline`, `grey_mean`,
    `posterior` (of a Bayes filter), `features` (of rules, with their `limits`), `error` and
    `error_path` (with ground truth), `pose`, `difference` (with a reference).
    """
    folder.mkdir(parents=True, exist_ok=True)
    true = truth.trajectory if truth else Trajectory.empty()
    errors = absolute_errors(result.trajectory, true, association_gap_s)
    online = absolute_errors(result.online, true, association_gap_s)
    T_map_gt = se3.inverse(errors.T_gt_map) if len(errors.errors_m) else None
    drawn: dict[str, Callable[[], Any]] = {
        "map": lambda: draw_map(result, truth, T_map_gt),
        "path": lambda: draw_path(result, truth, T_map_gt),
        "view": lambda: draw_view(result),
        "timeline": lambda: draw_timeline(result, truth),
        "grey_mean": lambda: draw_votes(result, truth, threshold, value_label),
        "posterior": lambda: draw_posterior(result, truth),
        "features": lambda: draw_features(result, truth, limits),
        "error": lambda: draw_series(
            result,
            errors.stamps_ns,
            errors.errors_m,
            y_label="position error [m]",
            online_m=_online(errors, online),
        ),
        "error_path": lambda: draw_error_path(result, errors),
        "pose": lambda: draw_pose(result, truth, T_map_gt),
    }
    if reference is not None:
        difference = compare(result.trajectory, reference, association_gap_s)
        drawn["difference"] = lambda: draw_series(
            result,
            difference.stamps_ns,
            difference.differences_m,
            y_label="difference [m]",
            limit_m=_PAPER_DIFFERENCE_M,
        )
    return [
        figure
        for name, draw in drawn.items()
        if (figure := _written(folder, name, draw, [] if faults is None else faults)) is not None
    ]


def _written(folder: Path, name: str, draw: Callable[[], Any], faults: list[str]) -> Drawn | None:
    """Draw and write one figure; None if there is nothing to draw or it fails."""
    try:
        figure = draw()
        if figure is None:
            return None
        png = look.save(figure, folder / f"{name}.png")
        svg = look.for_page(look.save_svg(figure, png.with_suffix(".svg")))
        return Drawn(name=name, png=png, svg=svg)
    except Exception as error:
        _log.info("the figure %s", name, exc_info=error)
        faults.append(f"the figure {name} could not be drawn: {text_of(error)}")
        return None


def _online(errors: AbsoluteErrors, online: AbsoluteErrors) -> NDArray[np.float64] | None:
    """Return the online errors at the stamps of the revised ones, None if they are equal."""
    if not np.array_equal(errors.stamps_ns, online.stamps_ns):
        return None
    differs = np.abs(errors.errors_m - online.errors_m) > _ONLINE_DIFFERS_M
    return online.errors_m if differs.any() else None
