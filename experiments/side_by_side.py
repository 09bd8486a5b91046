"""Run modules alone over the same recordings, one after the other, and print what each gave.

    python experiments/side_by_side.py ../shared/data [--mrpt ./mrpt_rbpf] [--only NAME ...]

Every run is `python -m sceneslam` in a process of its own. CPU time is that of this process and of
all that it started, memory that of the largest of them; the row `reading` (no SLAM at all) is what
of it is not the module's. Errors (ATE; on Intel the mean over the relations) are of the poses as
reported at the time and as revised at the end. A module whose library is missing is left out, with
a line that says so.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sceneslam.evaluation.files import read_poses
from sceneslam.evaluation.relations import Relations, relation_errors

TABLE = Path(__file__).resolve().parent / "results" / "modules" / "side_by_side.csv"
COLUMNS = (
    "recording", "module", "reported [m]", "revised [m]", "coverage [%]", "CPU per image [ms]",
    "memory [MB]",
)  # fmt: skip
EXTRAS = {"orb_slam3": "pyorbslam3", "genz_icp": "genz_icp"}
CAMERA = ["fx=585", "fy=585", "cx=320", "cy=240"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """What selects a recording, and which modules it suits."""

    source: tuple[str, ...]
    modules: tuple[str, ...]
    relations: str | None = None  # a file of relative poses; None: ground truth


RECORDINGS = {
    "freiburg1_rpy": Recording(
        source=("source=tum_rgbd", "source.path={data}/tum_fr1_rpy"),
        modules=("rgbd", "orb_slam3", "depth", "direct"),
    ),
    "RedKitchen": Recording(
        source=(
            "source=tum_rgbd",
            "source.path={data}/7scenes_redkitchen",
            "source.depth_scale=1000",
            *(f"source.camera.{one}" for one in CAMERA),
        ),
        modules=("rgbd", "orb_slam3", "depth", "direct"),
    ),
    "Intel, 2,500 scans": Recording(
        source=(
            "source=carmen",
            "source.path={data}/carmen_intel/intel.clf",
            "run.max_observations=2500",
        ),
        modules=("odometry", "laser", "mrpt_rbpf"),
        relations="{data}/carmen_intel/intel.relations",
    ),
    "KITTI 0001": Recording(
        source=("source=kitti", "source.path={data}/kitti_raw_2011_09_26_drive_0001"),
        modules=("kiss_icp", "genz_icp"),
    ),
}


def missing(module: str, mrpt: Path | None) -> str:
    """Return why a module cannot be run here, "" where it can."""
    if module == "mrpt_rbpf" and mrpt is None:
        return "--mrpt names no program; python -m sceneslam.modules.slam.process builds it"
    package = EXTRAS.get(module)
    if package is not None and importlib.util.find_spec(package) is None:
        return f"pip install 'sceneslam[{module}]'"
    return ""


def chosen(module: str, mrpt: Path | None) -> list[str]:
    """Return the overrides that select a module; without one, nothing is tracked."""
    if module == "reading":
        return ["run=detect_only"]
    if module == "mrpt_rbpf":
        assert mrpt is not None
        program = f"[{mrpt.resolve()}]"
        return [
            "slam@slam.only=process",
            f"slam.only.command={program}",
            f"allow_targets={program}",
        ]
    return [f"slam@slam.only={module}"]


def run(recording: Recording, module: str, data: Path, mrpt: Path | None) -> list[str]:
    """Return a row of the table."""
    with tempfile.TemporaryDirectory() as own:
        folder = Path(own, "run")
        command = [
            sys.executable, "-m", "sceneslam", "+scenario=single",
            *(part.format(data=data) for part in recording.source),
            *chosen(module, mrpt),
            "run.progress=false", "run.report=false", f"hydra.run.dir={folder}",
        ]  # fmt: skip
        environment = os.environ | {"SCENESLAM_CACHE_DIR": own}  # else a second one reads nothing
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment
        ) as process:
            assert process.stdout is not None
            said = process.stdout.read().decode(errors="replace")
            _, status, spent = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        metrics = folder / "metrics.json"
        if not metrics.is_file():
            raise SystemExit(f"{module}: no metrics\n{said}")
        found = json.loads(metrics.read_text())
        cpu_ms = 1e3 * (spent.ru_utime + spent.ru_stime) / found["observations"]
        memory_mb = spent.ru_maxrss / 1024
        if module == "reading":
            return [module, "-", "-", "-", f"{cpu_ms:.0f}", f"{memory_mb:.0f}"]
        if recording.relations is None:
            errors_m = [found["ate_online_m"], found["ate_rmse_m"]]
        else:
            relations = Relations.read(Path(recording.relations.format(data=data)))
            names = ("trajectory_online.tum", "trajectory.tum")
            poses = [read_poses(folder / name) for name in names]
            errors_m = [relation_errors(one, relations)["trans_mean_m"] for one in poses]
        shown = ["-" if one is None else f"{one:.3f}" for one in errors_m]
        coverage = f"{100 * found['coverage']:.1f}"
        return [module, *shown, coverage, f"{cpu_ms:.0f}", f"{memory_mb:.0f}"]


def rows(data: Path, mrpt: Path | None, only: list[str]) -> Iterator[list[str]]:
    """Yield the table's rows, as they are ready."""
    for name, recording in RECORDINGS.items():
        if only and name not in only:
            continue
        for module in ("reading", *recording.modules):
            reason = missing(module, mrpt)
            if reason:
                print(f"{name}, {module}: left out, {reason}", file=sys.stderr)
            else:
                yield [name, *run(recording, module, data, mrpt)]


def main() -> None:
    """Print the table, and keep a whole one as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--mrpt", type=Path)
    parser.add_argument("--only", nargs="+", choices=RECORDINGS, default=[])
    arguments = parser.parse_args()
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    table = []
    for row in rows(arguments.data, arguments.mrpt, arguments.only):
        print(f"| {' | '.join(row)} |", flush=True)
        table.append(row)
    if not arguments.only:
        TABLE.parent.mkdir(parents=True, exist_ok=True)
        with TABLE.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *table])


if __name__ == "__main__":
    main()
