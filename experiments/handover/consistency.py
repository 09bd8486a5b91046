"""The experiment `consistency`: whether a trajectory is as far off as its covariance says.

`conf/experiment/consistency.yaml` says how it is called, `experiments/handover.md` what was
found. NEES: normalised estimation error squared (Bar-Shalom, Li, Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, Sec. 5.4), averaged over seeded runs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.uncertainty import read_covariances
from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.trajectory import Trajectory

_PARTS = {"position": slice(0, 3), "rotation": slice(3, 6)}
_FLOORS = {"position": 1e-4, "rotation": 1e-4}  # m, rad: where the map begins nothing is unsure
_NORMAL_95 = 1.959964


class ConsistencyExperiment:
    """Runs stories with several seeds and holds errors against covariances."""

    def __init__(
        self, *, stories: Sequence[str], seeds: Sequence[int], nees_ratio_range: Sequence[float]
    ) -> None:
        if len(seeds) < 2 or min(seeds) < 0:
            raise ConfigError("seeds", list(seeds), "two or more, 0 or above")
        if len(nees_ratio_range) != 2 or not 0 < nees_ratio_range[0] < nees_ratio_range[1]:
            allowed = "two rising numbers above 0"
            raise ConfigError("nees_ratio_range", list(nees_ratio_range), allowed)
        self._stories, self._seeds = stories, seeds
        self._low, self._high = nees_ratio_range

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return, per story, the mean NEES over its expectation, and how often it is in its band.

        Neither side of the range can be had for nothing: an infinite covariance has a NEES of 0.
        """
        trials = [
            Trial(name=f"{story}/seed_{seed}", overrides=(f"story={story}", f"seed={seed}"))
            for story in self._stories
            for seed in self._seeds
        ]
        outcomes, rows, figures = run_trials(trials), [], []
        for story in self._stories:
            runs = [_nees(next(outcomes)) for _ in self._seeds]
            for part in _PARTS:
                row, figure = self._summarise(story, part, [run[part] for run in runs])
                rows.append(row)
                figures.append(figure)
        columns = ("story", "of", "NEES / 3", "band", "inside", "above it", "below it")
        return Verdict(figures=figures, table=Table(columns=columns, rows=rows))

    def _summarise(
        self, story: str, part: str, runs: Sequence[NDArray[np.float64]]
    ) -> tuple[list[str | float | None], Figure]:
        count = min(len(run) for run in runs)
        mean = np.mean([run[:count] for run in runs], axis=0)[1:]  # at the first nothing is off
        low, high = _chi2_band(3 * len(runs)) / len(runs)
        above, below = float((mean > high).mean()), float((mean < low).mean())
        ratio = float(mean.mean()) / 3.0
        name = f"{story}: NEES of {part} over its expectation"
        figure = Figure.between(name, ratio, self._low, self._high)
        band = f"{low / 3:.2f} to {high / 3:.2f}"
        return [story, part, ratio, band, 1.0 - above - below, above, below], figure


def _nees(outcome: TrialResult) -> dict[str, NDArray[np.float64]]:
    """Return the NEES (N,) of position and of rotation, 3 degrees of freedom each, at every pose.

    Estimate and truth begin at the same pose.
    """
    stamps_ns, covariances = read_covariances(outcome.folder / "trajectory_covariance.txt")
    estimate = outcome.trajectory
    assert np.array_equal(stamps_ns, estimate.stamps_ns)
    truth = Trajectory.read_tum(outcome.folder / "groundtruth.tum")
    T_gt_base = interpolated(truth, stamps_ns).T_world_base
    T_map_true = estimate.T_world_base[0] @ se3.inverse(T_gt_base[0]) @ T_gt_base
    errors = np.array([se3.log(T) for T in se3.inverse(estimate.T_world_base) @ T_map_true])
    return {part: np.array(list(_normalised(errors, covariances, part))) for part in _PARTS}


def _normalised(
    errors: NDArray[np.float64], covariances: NDArray[np.float64], part: str
) -> Iterator[float]:
    axes = _PARTS[part]
    floor = _FLOORS[part] ** 2 * np.eye(3)
    for error, covariance in zip(errors[:, axes], covariances[:, axes, axes], strict=True):
        yield float(error @ np.linalg.solve(covariance + floor, error))


def _chi2_band(degrees: int) -> NDArray[np.float64]:
    """Return the 2.5 % and 97.5 % quantiles (Wilson and Hilferty, PNAS 1931)."""
    spread = 2.0 / (9.0 * degrees)
    return np.asarray(
        degrees * (1.0 - spread + _NORMAL_95 * np.sqrt(spread) * np.array([-1, 1])) ** 3
    )
