"""One run of the matrix in numbers, and their mean and deviation over seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sceneslam.evaluation.accuracy import absolute_errors, root_mean_square
from sceneslam.evaluation.correctness import CorrectLimits, correct_rate
from sceneslam.evaluation.path import segment_errors
from sceneslam.types.experiment import TrialResult
from sceneslam.types.trajectory import Trajectory

_GAP_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A story under a strategy, with one seed or as the mean (or deviation) over seeds."""

    story: str
    seed: int | None  # None in a mean over seeds
    strategy: str
    coverage: float
    correct_rate: float
    segment_m: float  # error of the motion over a stretch of the path
    ate_m: float
    ate_rot_rad: float
    length_ratio: float
    switches: float
    false_switches: float
    regret: float = float("nan")  # segment_m over the oracle's, minus 1

    @classmethod
    def of(
        cls, story: str, seed: int, strategy: str, outcome: TrialResult, *, observations: int
    ) -> Cell:
        """Return a run's numbers; what it could not have (no pose) is NaN.

        A run that ended before it had seen all `observations` has no pose for the others.
        """
        metrics = outcome.metrics
        share = metrics["observations"] / max(observations, 1)
        names = ("ate_rot_rad", "length_ratio", "false_switches")
        return cls(
            story=story,
            seed=seed,
            strategy=strategy,
            coverage=share * _number(metrics["coverage"]),
            correct_rate=share * _number(metrics["correct_rate"]),
            ate_m=_number(metrics["ate_rmse_m"]),
            segment_m=_number(metrics["segment_trans_m"]),
            switches=float(len(metrics["switches"])),
            **{name: _number(metrics[name]) for name in names},
        )

    @property
    def oracle_m(self) -> float:
        """Return the oracle's `segment_m` in the same drive."""
        return self.segment_m / (1.0 + self.regret)

    def beside(self, oracle: Cell) -> Cell:
        """Return the cell with its regret."""
        return replace(self, regret=self.segment_m / oracle.segment_m - 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Judge:
    """How a trajectory that no run gave is judged, as the runs are."""

    limits: CorrectLimits
    segment_m: float

    def cell(
        self, story: str, seed: int, strategy: str, estimate: Trajectory, truth: Trajectory
    ) -> Cell:
        """Return its numbers; it has a pose wherever it was asked."""
        segments = segment_errors(estimate, truth, _GAP_S, self.segment_m)
        nan = float("nan")
        return Cell(
            story=story,
            seed=seed,
            strategy=strategy,
            coverage=1.0,
            correct_rate=correct_rate(estimate, truth, self.limits),
            segment_m=root_mean_square(segments.trans_m),
            ate_m=absolute_errors(estimate, truth, _GAP_S).rmse_m,
            ate_rot_rad=nan,
            length_ratio=nan,
            switches=nan,
            false_switches=nan,
            regret=0.0,
        )


def regret_of(cells: Sequence[Cell]) -> float:
    """Return the regret over several drives: their errors together over the oracle's, minus 1.

    Of drives with errors of millimetres the ratio is noise; here every millimetre counts alike.
    """
    return sum(cell.segment_m for cell in cells) / sum(cell.oracle_m for cell in cells) - 1.0


def mean(cells: Sequence[Cell]) -> list[Cell]:
    """Return the means over seeds, one per story and strategy."""
    return [_over(group, np.mean) for group in _groups(cells)]


def deviation(cells: Sequence[Cell]) -> list[Cell]:
    """Return the sample standard deviations over seeds, one per story and strategy.

    That of a single seed is 0.
    """
    return [_over(group, _sample_deviation) for group in _groups(cells)]


def rows_of(cells: Iterable[Cell]) -> Iterator[list[str | float | None]]:
    """Yield the cells as rows of a table, their field names first."""
    names = [field.name for field in fields(Cell)]
    yield [*names]
    for cell in cells:
        yield [getattr(cell, name) for name in names]


def _groups(cells: Sequence[Cell]) -> list[list[Cell]]:
    groups: dict[tuple[str, str], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.story, cell.strategy), []).append(cell)
    return [*groups.values()]


def _over(group: Sequence[Cell], reduce: Callable[[list[float]], Any]) -> Cell:
    numbers = [field.name for field in fields(Cell) if field.type == "float"]
    values: dict[str, Any] = {
        name: float(reduce([getattr(one, name) for one in group])) for name in numbers
    }
    return replace(group[0], **values, seed=None)


def _sample_deviation(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)
