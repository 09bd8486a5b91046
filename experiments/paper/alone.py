"""IV-B: each module alone over one path, with the lights on and off (Fig. 6)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path

from sceneslam.evaluation.figures import style as look
from sceneslam.experiments.paper.images import draw_rooms
from sceneslam.experiments.paper.runs import keep_figure, number
from sceneslam.experiments.paper.views import cloud_of, draw_third_person, read_ply
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_above, check_among, check_some


class AloneExperiment:
    """Runs every module in every light; `own` names the light that each is meant for."""

    def __init__(self, *, own: Mapping[str, str], ate_max_m: Mapping[str, float]) -> None:
        check_some(own=own)
        check_among([*own], ate_max_m=[*ate_max_m])
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
                    Figure.at_most(f"{name}: ATE RMSE", ate_m, self._ate_max_m[key], "m"),
                ]
                keep_figure(outcome, "map", folder / f"{key}.png")
                _draw_features(outcome, folder / f"{key}_features.png")
                if lights == "on":
                    draw_rooms(folder / "rooms.png", outcome.folder)
            frame_ms = metrics["modules"].get(key, {}).get("frame_ms", {}).get("median")
            correct = 100 * number(metrics["correct_rate"])
            rows.append((key, lights, 100 * coverage, correct, 100 * ate_m, frame_ms))
        columns = ("module", "lights", "coverage [%]", "correct [%]", "ATE [cm]", "median [ms]")
        pictures = {"rooms.png": "The robot at its start, and what its camera saw of the rooms."}
        for key, lights in self._own.items():
            pictures[f"{key}.png"] = f"Map and path of {key} alone, lights {lights}."
            pictures[f"{key}_features.png"] = f"The landmarks of {key}, and its path."
        table = Table(columns=columns, rows=rows)
        return Verdict(figures=figures, table=table, pictures=pictures)


def _draw_features(outcome: TrialResult, path: Path) -> None:
    """Draw the 3D feature points, where the module keeps any (Fig. 6a)."""
    landmarks = outcome.folder / "map" / "landmarks.ply"
    if landmarks.is_file():
        cloud = cloud_of(read_ply(landmarks), look.PALETTE[0], "feature points")
        draw_third_person(path, [cloud], {"path": outcome.trajectory})


def _trial(key: str, lights: str) -> Trial:
    table = f"scenes={{Bright: [{key}], Dark: [{key}]}}"
    return Trial(name=f"{key}/lights_{lights}", overrides=(f"lights={lights}", table))
