"""IV-D as the paper did it: one recording, and a switch that is ordered by hand (Fig. 8).

All lamps are on, and every run sees the same images. One keeps its module; in the others the
operator orders the other module at one instant, whatever the light.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.evaluation.association import select
from sceneslam.evaluation.comparison import Difference, compare
from sceneslam.evaluation.figures.paths import draw_paths
from sceneslam.experiments.paper.runs import number
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_among, check_some
from sceneslam.types.trajectory import Trajectory

_KEPT = "unswitched"


class OrderedSwitchExperiment:
    """Compares runs with a switch at `at_s` with the one that keeps its module."""

    def __init__(
        self,
        *,
        at_s: float,
        scenes: Sequence[str],
        switched: Mapping[str, Mapping[str, Any]],
        judged: str,
        difference_max_m: float,
    ) -> None:
        check_some(switched=switched, scenes=scenes)
        check_above(0, at_s=at_s, difference_max_m=difference_max_m)
        check_among([*switched], judged=judged)
        self._at_s, self._scenes, self._switched = at_s, scenes, switched
        self._judged, self._difference_max_m = judged, difference_max_m

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return how far each switched run is off the one without, before and after the switch."""
        first, second = self._scenes
        stay = {"detector": {"schedule": [[0.0, first]]}}
        change = {"detector": {"schedule": [[0.0, first], [self._at_s, second]]}}
        trials = [Trial(name=_KEPT, values=stay)]
        trials += [
            Trial(name=name, values={**change, **values}) for name, values in self._switched.items()
        ]
        kept, *outcomes = run_trials(trials)
        truth = Trajectory.read_tum(kept.folder / "groundtruth.tum")
        of = dict(zip(self._switched, outcomes, strict=True))
        paths = {name: one.trajectory for name, one in {_KEPT: kept, **of}.items()}
        draw_paths(folder / "paths.png", paths, truth)
        gap_s = kept.metrics["association_gap_s"]
        apart = {name: compare(one.trajectory, kept.trajectory, gap_s) for name, one in of.items()}
        before = {name: self._before(one, kept) for name, one in of.items()}
        rows = [_row(name, of[name], before[name], apart[name]) for name in of]
        rows.append((_KEPT, None, None, None, *_errors_cm(kept)))
        columns = ("run", "apart before the switch [cm]", "apart at most [cm]", "RMS [cm]")
        return Verdict(
            figures=list(self._figures(before, apart)),
            table=Table(columns=(*columns, "ATE [cm]", "largest error [cm]"), rows=rows),
            pictures={"paths.png": "All runs over the same images, from above."},
        )

    def _before(self, switched: TrialResult, kept: TrialResult) -> float:
        """Return how far two runs are apart at most before the switch, as they told it live [m]."""
        stamps_ns = switched.online.stamps_ns
        ordered_ns = stamps_ns[0] + round(self._at_s * 1e9)
        until = select(switched.online, np.flatnonzero(stamps_ns < ordered_ns))
        return compare(until, kept.online, kept.metrics["association_gap_s"]).max_m

    def _figures(
        self, before: Mapping[str, float], apart: Mapping[str, Difference]
    ) -> Iterator[Figure]:
        for name, before_m in before.items():
            yield Figure.at_most(f"{name}: apart before the switch", before_m, 0.0, "m")
        name = f"{self._judged}: apart at most"
        yield Figure.at_most(name, apart[self._judged].max_m, self._difference_max_m, "m")


def _row(
    name: str, outcome: TrialResult, before_m: float, apart: Difference
) -> tuple[str | float | None, ...]:
    return (name, 100 * before_m, 100 * apart.max_m, 100 * apart.rms_m, *_errors_cm(outcome))


def _errors_cm(outcome: TrialResult) -> tuple[float, float]:
    metrics = outcome.metrics
    return 100 * number(metrics["ate_rmse_m"]), 100 * number(metrics["ate_max_m"])
