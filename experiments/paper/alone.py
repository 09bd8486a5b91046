"""IV-B: each module alone over one path, with the lights on and off (Fig. 6)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path

from sceneslam.experiments.paper.runs import keep_figure, number
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, Verdict
from sceneslam.types.ranges import check_above, check_among, check_some


class AloneExperiment:
    """Runs every module in every light; `own` names the light that each is meant for."""

    def __init__(self, *, own: Mapping[str, str], ate_max_m: float) -> None:
        check_some(own=own)
        check_among(("on", "off", "story"), own=list(own.values()))
        check_above(0, ate_max_m=ate_max_m)
        self._own, self._ate_max_m = own, ate_max_m

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Return the errors; a module in its own light has to keep its pose and its bound."""
        cells = list(product(self._own, dict.fromkeys(self._own.values())))
        figures, rows = [], []
        for (key, lights), outcome in zip(
            cells, run_trials([_trial(*cell) for cell in cells]), strict=True
        ):
            metrics = outcome.metrics
            ate_m, coverage = number(metrics["ate_rmse_m"]), number(metrics["coverage"])
            if self._own[key] == lights:
                name = f"{key}, lights {lights}"
                figures += [
                    Figure.at_least(f"{name}: coverage", coverage, 1.0),
                    Figure.at_most(f"{name}: ATE RMSE", ate_m, self._ate_max_m, "m"),
                ]
                keep_figure(outcome, "map", folder / f"{key}.png")
            frame_ms = metrics["modules"].get(key, {}).get("frame_ms", {}).get("median")
            correct = 100 * number(metrics["correct_rate"])
            rows.append((key, lights, 100 * coverage, correct, 100 * ate_m, frame_ms))
        columns = ("module", "lights", "coverage [%]", "correct [%]", "ATE [cm]", "median [ms]")
        pictures = {
            f"{key}.png": f"Map and path of {key} alone, lights {lights}."
            for key, lights in self._own.items()
        }
        table = Table(columns=columns, rows=rows)
        return Verdict(figures=figures, table=table, pictures=pictures)


def _trial(key: str, lights: str) -> Trial:
    table = f"scenes={{Bright: [{key}], Dark: [{key}]}}"
    return Trial(name=f"{key}/lights_{lights}", overrides=(f"lights={lights}", table))
