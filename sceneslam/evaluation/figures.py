"""All figures of a run, written as PNG files."""

from __future__ import annotations

from pathlib import Path

from sceneslam.evaluation import figure_style as look
from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.comparison import compare
from sceneslam.evaluation.figure_map import draw_map
from sceneslam.evaluation.figure_time import draw_series, draw_timeline, draw_votes
from sceneslam.types import se3
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_PAPER_DIFFERENCE_M = 0.10  # "less than 10 cm" between the switched and the unswitched run


def write_figures(
    folder: Path,
    result: RunResult,
    truth: GroundTruth | None,
    *,
    threshold: float | None,
    value_label: str = "detector value",
    reference: Trajectory | None = None,
    association_gap_s: float = 0.01,
) -> list[Path]:
    """Write what can be drawn of a run; return the files, in the order of the story.

    `grey_mean`, `map`, `timeline`, `error` (with ground truth), `difference` (with a reference).
    """
    folder.mkdir(parents=True, exist_ok=True)
    true = truth.trajectory if truth else Trajectory.empty()
    errors = absolute_errors(result.trajectory, true, association_gap_s)
    T_map_gt = se3.inverse(errors.T_gt_map) if len(errors.errors_m) else None
    drawn = {
        "grey_mean": draw_votes(result, truth, threshold, value_label),
        "map": draw_map(result, truth, T_map_gt),
        "timeline": draw_timeline(result, truth),
        "error": draw_series(
            result, errors.stamps_ns, errors.errors_m, y_label="position error [m]"
        ),
    }
    if reference is not None:
        difference = compare(result.trajectory, reference, association_gap_s)
        drawn["difference"] = draw_series(
            result,
            difference.stamps_ns,
            difference.differences_m,
            y_label="difference [m]",
            limit_m=_PAPER_DIFFERENCE_M,
        )
    return [
        look.save(figure, folder / f"{name}.png")
        for name, figure in drawn.items()
        if figure is not None
    ]
