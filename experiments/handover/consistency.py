"""The experiment `consistency`: whether a trajectory is as far off as its covariance says.

`conf/experiment/consistency.yaml` says how it is called, `experiments/handover.md` what was
found. NEES: normalised estimation error squared (Bar-Shalom, Li, Kirubarajan, "Estimation with
Applications to Tracking and Navigation", 2001, Sec. 5.4), averaged over seeded runs.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.uncertainty import read_covariances
from sceneslam.evaluation.association import interpolated
from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.trajectory import Trajectory

_PARTS = {"position": [0, 1, 2], "rotation": [3, 4, 5], "x, y": [0, 1], "heading": [5]}
_PROMISED = ("position", "rotation")
_STRETCHES = ("before", "after")  # the first hand-over
_COLUMNS = (
    *("story", "of", "hand-over", "NEES / expectation"),
    *("95 % band of the mean", "within", "too certain", "too uncertain"),
)
_FLOOR = 1e-4  # m, rad: where the map begins nothing is uncertain
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
            for part, axes in _PARTS.items():
                for stretch in _STRETCHES:
                    ratios = [run[part, stretch] / len(axes) for run in runs]
                    rows.append([story, part, stretch, *_summary(ratios, len(axes))])
                    if part in _PROMISED:
                        name = f"{story}: NEES of {part} {stretch} the hand-over, over expectation"
                        ratio = float(np.mean([value.mean() for value in ratios]))
                        figures.append(Figure.between(name, ratio, self._low, self._high))
        return Verdict(figures=figures, table=Table(columns=_COLUMNS, rows=rows))


def _summary(ratios: Sequence[NDArray[np.float64]], degrees: int) -> list[str | float | None]:
    """Return the mean, and how often the mean over the runs is in, above and below its band."""
    count = min(len(run) for run in ratios)
    mean = np.mean([run[:count] for run in ratios], axis=0)
    low, high = _chi2_band(degrees * len(ratios)) / (degrees * len(ratios))
    above, below = float((mean > high).mean()), float((mean < low).mean())
    overall = float(np.mean([run.mean() for run in ratios]))
    return [overall, f"{low:.2f} to {high:.2f}", 1.0 - above - below, above, below]


def _nees(outcome: TrialResult) -> dict[tuple[str, str], NDArray[np.float64]]:
    """Return the NEES of each part, at every pose before and after the first hand-over."""
    stamps_ns, errors, covariances = errors_of(outcome.folder)
    seam = int(np.searchsorted(stamps_ns, _handover_ns(outcome.folder)))
    rows = {"before": slice(1, seam), "after": slice(seam, None)}
    return {
        (part, stretch): normalised(errors[rows[stretch]], covariances[rows[stretch]], axes)
        for part, axes in _PARTS.items()
        for stretch in _STRETCHES
    }


def _handover_ns(folder: Path) -> int:
    """Return the stamp of the first pose that the second session gave."""
    lines = (folder / "events.jsonl").read_text().splitlines()
    starts = [event for event in map(json.loads, lines) if event["event"] == "uncertainty"]
    return int(starts[1]["stamp_ns"])


def errors_of(
    folder: Path,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return a run's stamps (N,), errors (N, 6) and covariances (N, 6, 6) where truth is known.

    Of se3.log order [m, rad], in base. Estimate and truth begin at the same pose, at which nothing
    is off.
    """
    stamps_ns, covariances = read_covariances(folder / "trajectory_covariance.txt")
    estimate = Trajectory.read_tum(folder / "trajectory.tum")
    truth = Trajectory.read_tum(folder / "groundtruth.tum")
    assert np.array_equal(stamps_ns, estimate.stamps_ns)
    known = (stamps_ns >= truth.stamps_ns[0]) & (stamps_ns <= truth.stamps_ns[-1])
    T_map_base = estimate.T_world_base[known]
    T_gt_base = interpolated(truth, stamps_ns[known]).T_world_base
    T_map_true = T_map_base[0] @ se3.inverse(T_gt_base[0]) @ T_gt_base
    errors = se3.log(se3.inverse(T_map_base) @ T_map_true)
    return stamps_ns[known], errors, covariances[known]


def normalised(
    errors: NDArray[np.float64], covariances: NDArray[np.float64], axes: Sequence[int]
) -> NDArray[np.float64]:
    """Return the NEES (N,) of `axes`, as many as these in the mean where covariances are right."""
    known = covariances[:, axes][:, :, axes] + _FLOOR**2 * np.eye(len(axes))
    off = errors[:, axes]
    return np.asarray(np.einsum("ni,nij,nj->n", off, np.linalg.inv(known), off))


def _chi2_band(degrees: int) -> NDArray[np.float64]:
    """Return the 2.5 % and 97.5 % quantiles (Wilson and Hilferty, PNAS 1931)."""
    spread = 2.0 / (9.0 * degrees)
    return np.asarray(
        degrees * (1.0 - spread + _NORMAL_95 * np.sqrt(spread) * np.array([-1, 1])) ** 3
    )
