"""One run of the matrix in numbers, and their mean over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.evaluation.correctness import correct_rate
from sceneslam.types.experiment import Outcome
from sceneslam.types.trajectory import Trajectory

_LIMIT_M, _LIMIT_RAD = 0.25, np.deg2rad(10.0)  # of `conf/evaluation/default.yaml`
_GAP_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Strategy:
    """A way to drive: one module alone (then nothing is bridged), or a kind of hand-over."""

    name: str
    module: str = ""
    handover: str = "cold"


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A story under a strategy."""

    story: str
    seed: int | None  # None in a mean over seeds
    strategy: str
    ate_m: float
    correct_rate: float
    coverage: float
    switches: float
    false_switches: float

    @classmethod
    def of(cls, story: str, seed: int, strategy: str, outcome: Outcome) -> Cell:
        """Return a run's numbers; what it could not have (no pose) is NaN."""
        metrics = outcome.metrics
        values = {name: metrics[name] for name in ("correct_rate", "coverage", "false_switches")}
        return cls(
            story=story,
            seed=seed,
            strategy=strategy,
            ate_m=_number(metrics["ate_rmse_m"]),
            switches=float(len(metrics["switches"])),
            **{name: _number(value) for name, value in values.items()},
        )


def judge(story: str, seed: int, strategy: str, estimate: Trajectory, truth: Trajectory) -> Cell:
    """Return the numbers of a trajectory that no run gave."""
    rate = correct_rate(estimate, truth, limit_m=_LIMIT_M, limit_rad=float(_LIMIT_RAD))
    return Cell(
        story=story,
        seed=seed,
        strategy=strategy,
        ate_m=absolute_errors(estimate, truth, _GAP_S).rmse_m,
        correct_rate=rate,
        coverage=1.0,
        switches=0.0,
        false_switches=0.0,
    )


def mean(cells: Sequence[Cell]) -> list[Cell]:
    """Return the means over seeds, one per story and strategy."""
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.story, cell.strategy), []).append(cell)
    numbers = [field.name for field in fields(Cell) if field.type == "float"]
    return [
        Cell(
            story=story,
            seed=None,
            strategy=strategy,
            **{name: float(np.mean([getattr(one, name) for one in group])) for name in numbers},
        )
        for (story, strategy), group in groups.items()
    ]


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)
