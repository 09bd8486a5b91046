"""Print how well a second tour lies in the map of a first one.

    python experiments/tour_again.py FIRST_SEED SECOND_SEED

Three runs of `+scenario=office_tour`: the first saves its map, the second loads it, and the second
once more, without. Where both tours passed (within 0.3 m), the offset of the second from the first
is compared with the true one: that is how far the second lies off in the map, however the map is
bent.
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.evaluation.association import interpolated
from sceneslam.experiments.scripts import run
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory

NEAR_M = 0.3
HEAD = "first seed", "second seed", "in the map [mm]", "95 % [mm]", "largest [mm]"
HEAD += "on the way [mm]", "ATE in the map [mm]", "ATE alone [mm]", "located", "withdrawn"


def drive(seed: str, overrides: list[str], into: Path) -> Path:
    """Run a tour; return the folder of the run."""
    tour = ["+scenario=office_tour", f"seed={seed}", "source.camera.size_wh=[320,240]"]
    return run(into, *tour, *overrides, "run.report=false", "run.progress=false")


def off_m(first: Path, second: Path, name: str) -> NDArray[np.float64]:
    """Return how far (N,) [m] the second run lies off in the first one's map, in the plane."""
    true_first, true_second = (
        Trajectory.read_tum(folder / "groundtruth.tum") for folder in (first, second)
    )
    T_map_world = se3.inverse(true_first.T_world_base[0])
    mapped = Trajectory.read_tum(first / "trajectory.tum")
    own = Trajectory.read_tum(second / f"{name}.tum")
    due, due_mapped = (
        (T_map_world @ interpolated(truth, path.stamps_ns).T_world_base)[:, :2, 3]
        for truth, path in ((true_second, own), (true_first, mapped))
    )
    errors = []
    for place, at in zip(due, own.positions_m[:, :2], strict=True):
        away_m = np.linalg.norm(due_mapped - place, axis=1)
        nearest = int(np.argmin(away_m))
        if away_m[nearest] <= NEAR_M:
            moved = mapped.positions_m[nearest, :2] - due_mapped[nearest]
            errors.append(float(np.linalg.norm(at - place - moved)))
    return np.array(errors)


def ate_mm(folder: Path) -> str:
    """Return the absolute trajectory error of a run."""
    metrics = json.loads((folder / "metrics.json").read_text())
    return f"{1e3 * metrics['ate_rmse_m']:.0f}"


def main() -> None:
    """Run the tours, and print a row of the table."""
    first_seed, second_seed = sys.argv[1:]
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        first = drive(first_seed, [f"atlas.save={work / 'map'}"], work / "first")
        second = drive(second_seed, [f"atlas.load={work / 'map'}"], work / "second")
        alone = drive(second_seed, [], work / "alone")
        errors_m, online_m = (
            off_m(first, second, name) for name in ("trajectory", "trajectory_online")
        )
        lines = (second / "events.jsonl").read_text().splitlines()
        events = Counter(json.loads(line)["event"] for line in lines)
        row = [first_seed, second_seed, f"{1e3 * np.sqrt((errors_m**2).mean()):.0f}"]
        row += [f"{1e3 * value:.0f}" for value in (np.percentile(errors_m, 95), errors_m.max())]
        row += [f"{1e3 * np.sqrt((online_m**2).mean()):.0f}", ate_mm(second), ate_mm(alone)]
        row += [str(events["relocalized"]), str(events["relocalization_withdrawn"])]
    csv.writer(sys.stdout, lineterminator="\n").writerows([HEAD, row])


if __name__ == "__main__":
    main()
