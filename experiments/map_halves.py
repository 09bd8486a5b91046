"""Print how well a recording's second half is joined to the map of its first half.

    python experiments/map_halves.py FOLDER [OVERRIDES]

FOLDER is in the TUM layout; the overrides choose a module and the camera, as in
`slam@slam.only=depth source.camera.fx=585`. Three runs: the first half, which saves its map; the
second, which loads it; and the whole. The joined trajectory is that of both halves.
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.experiments.scripts import run
from sceneslam.types.trajectory import Trajectory

GAP_S = 0.01  # between a pose and its truth
HEAD = "recording", "module", "found after [s]", "joined [mm]", "whole [mm]", "ratio"


def halved(folder: Path, into: Path) -> list[Path]:
    """Return two folders with half of the images each; everything else is linked."""
    lines = [line for line in (folder / "rgb.txt").read_text().splitlines() if line[:1] != "#"]
    middle, halves = len(lines) // 2, []
    for number, part in enumerate((lines[:middle], lines[middle:])):
        half = into / f"{folder.name}_{number}"
        half.mkdir()
        (half / "rgb.txt").write_text("\n".join(part) + "\n")
        for path in folder.iterdir():
            if path.name != "rgb.txt":
                (half / path.name).symlink_to(path.resolve())
        halves.append(half)
    return halves


def follow(recording: Path, overrides: list[str], into: Path) -> Path:
    """Run a module alone over a recording; return the folder of the run."""
    alone = ["+scenario=single", "slam@slam.only=rgbd", "source=tum_rgbd"]
    quietly = ["run.report=false", "run.progress=false"]
    return run(into, *alone, f"source.path={recording}", *overrides, *quietly)


def main() -> None:
    """Run the halves and the whole, and print a row of the table."""
    folder, overrides = Path(sys.argv[1]), sys.argv[2:]
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        first, second = halved(folder, work)
        saved = work / "map"
        runs = [
            follow(first, [*overrides, f"atlas.save={saved}"], work / "first"),
            follow(second, [*overrides, f"atlas.load={saved}"], work / "second"),
            follow(folder, overrides, work / "whole"),
        ]
        truth = Trajectory.read_tum(runs[2] / "groundtruth.tum")
        parts = [Trajectory.read_tum(one / "trajectory.tum") for one in runs]
        lines = (runs[1] / "events.jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    found_s = [event["after_s"] for event in events if event["event"] == "relocalized"]
    joined = Trajectory(
        stamps_ns=np.concatenate([part.stamps_ns for part in parts[:2]]),
        T_world_base=np.concatenate([part.T_world_base for part in parts[:2]]),
    )
    joined_m, whole_m = (absolute_errors(one, truth, GAP_S).rmse_m for one in (joined, parts[2]))
    modules = [word.partition("=")[2] for word in overrides if word.startswith("slam@slam.only")]
    row = [folder.name, ["rgbd", *modules][-1], f"{found_s[0]:.1f}" if found_s else "-"]
    row += [f"{1e3 * joined_m:.1f}", f"{1e3 * whole_m:.1f}", f"{joined_m / whole_m:.2f}"]
    csv.writer(sys.stdout, lineterminator="\n").writerows([HEAD, row])


if __name__ == "__main__":
    main()
