"""IV-C: one switch, with the hybrid map and the global trajectory (Fig. 7)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.paper.runs import keep_figure, number
from sceneslam.experiments.paper.views import cloud_of, draw_third_person, modules_of, read_ply
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_among, check_least, check_some
from sceneslam.types.run import HANDOVERS


class SwitchExperiment:
    """Drives once with every kind of hand-over; the first named has to keep the bounds."""

    def __init__(
        self,
        *,
        handovers: Sequence[str],
        startup_s: Mapping[str, float],
        ate_max_m: float,
    ) -> None:
        check_some(handovers=handovers)
        check_among(HANDOVERS, handovers=handovers)
        check_least(0, startup_s=startup_s)
        check_above(0, ate_max_m=ate_max_m)
        self._handovers, self._startup_s, self._ate_max_m = handovers, startup_s, ate_max_m

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return what each kind gives; the map of the first is kept as a figure."""
        outcomes = list(run_trials([self._trial(kind) for kind in self._handovers]))
        keep_figure(outcomes[0], "map", folder / "map.png")
        _draw_map(outcomes[0], folder / "third_person.png")
        metrics = outcomes[0].metrics
        figures = [
            Figure.at_most(
                "switches, off the one that is due", abs(len(metrics["switches"]) - 1), 0.0
            ),
            Figure.at_least("coverage", number(metrics["coverage"]), 1.0),
            Figure.at_most("ATE RMSE", number(metrics["ate_rmse_m"]), self._ate_max_m, "m"),
        ]
        columns = ("hand-over", "switches", "coverage [%]", "gap [s]", "seam [cm]", "ATE [cm]")
        rows = [_row(*pair) for pair in zip(self._handovers, outcomes, strict=True)]
        return Verdict(
            figures=figures,
            table=Table(columns=(*columns, "max [cm]", "points"), rows=rows),
            pictures={
                "map.png": "One map of both modules, and one trajectory, from above.",
                "third_person.png": "The same in the third person, with the robot at its end.",
            },
        )

    def _trial(self, kind: str) -> Trial:
        """Return a run; only the paper's own hand-over waits for the module to start."""
        waits = self._startup_s.items() if kind == "cold" else ()
        starts = [f"++policy.startup_s.{key}={time_s}" for key, time_s in waits]
        return Trial(name=kind, overrides=(f"policy.handover={kind}", *starts))


def _draw_map(outcome: TrialResult, path: Path) -> None:
    """Draw the points of every module in its colour, the path, and the robot."""
    points, trajectory = outcome.folder / "map" / "points.ply", outcome.trajectory
    if not points.is_file() or not len(trajectory):
        return
    rows = read_ply(points)
    clouds = [
        cloud_of(rows[rows["module"] == number], look.PALETTE[number], name)
        for number, name in enumerate(modules_of(points))
    ]
    draw_third_person(path, clouds, {"path": trajectory}, [trajectory.T_world_base[-1]])


def _row(kind: str, outcome: TrialResult) -> tuple[str | float, ...]:
    metrics = outcome.metrics
    switches = metrics["switches"]
    seams_m = [number(switch["jump_m"]) for switch in switches if switch["jump_is_error"]]
    return (
        kind,
        float(len(switches)),
        100 * number(metrics["coverage"]),
        max((number(switch["gap_s"]) for switch in switches), default=0.0),
        100 * max(seams_m, default=math.nan),
        100 * number(metrics["ate_rmse_m"]),
        100 * number(metrics["ate_max_m"]),
        _points(outcome.folder / "map" / "points.ply"),
    )


def _points(path: Path) -> float:
    """Return how many points a PLY file says it holds."""
    with path.open("rb") as file:
        for line in file:
            if line.startswith(b"element vertex"):
                return float(line.split()[-1])
    return 0.0
