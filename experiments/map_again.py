"""Print how straight a map is as run after run is saved in it.

    python experiments/map_again.py SCENARIO SEED,SEED,... [OVERRIDES]

Every run but the first loads the map of those before, and saves it with itself in it. The map's
error is that of its submaps in the plane, all of them aligned at once with the runs' true poses.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.lasting.map_files import load_map_files
from sceneslam.evaluation.accuracy import root_mean_square
from sceneslam.evaluation.alignment import align
from sceneslam.evaluation.association import interpolated
from sceneslam.experiments.scripts import run
from sceneslam.types.trajectory import Trajectory

HEAD = "seed", "ATE of the run [mm]", "submaps", "not joined", "map [mm]", "its first run [mm]"


def errors_m(folder: Path, truths: Sequence[Trajectory]) -> tuple[NDArray[np.float64], int]:
    """Return the run and the error [m] of each submap (N, 2), and how many are not joined."""
    saved = load_map_files(folder)
    joined = saved.nodes()
    true, runs = [], np.array([saved.submaps[node].run for node in joined])
    for node in joined:
        submap = saved.submaps[node]
        true.append(interpolated(truths[submap.run], submap.stamps_ns[:1]).T_world_base[0])
    mapped, T_world_node = saved.T_map_node[joined], np.array(true)
    off_m = (align(mapped, T_world_node) @ mapped - T_world_node)[:, :2, 3]
    rows = np.column_stack([runs, np.linalg.norm(off_m, axis=1)])
    return rows, len(saved.submaps) - len(joined)


def main() -> None:
    """Make the runs, and print a row of the table after each."""
    scenario, seeds, *overrides = sys.argv[1:]
    print(",".join(HEAD), flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        work, truths = Path(scratch), list[Trajectory]()
        saved = work / "map"
        for seed in seeds.split(","):
            load = [f"atlas.load={saved}"] if truths else []
            words = [f"+scenario={scenario}", f"seed={seed}", *overrides, *load]
            words += [f"atlas.save={saved}", "run.report=false", "run.progress=false"]
            folder = run(work / f"run_{len(truths)}", *words)
            truths.append(Trajectory.read_tum(folder / "groundtruth.tum"))
            ate_m = json.loads((folder / "metrics.json").read_text())["ate_rmse_m"]
            found, apart = errors_m(saved, truths)
            whole_m, first_m = (
                root_mean_square(rows[:, 1]) for rows in (found, found[found[:, 0] == 0])
            )
            row = [f"{1e3 * value:.1f}" for value in (ate_m, whole_m, first_m)]
            print(",".join([seed, row[0], str(len(found)), str(apart), *row[1:]]), flush=True)


if __name__ == "__main__":
    main()
