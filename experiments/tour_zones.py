"""Show in which zone of the building each strategy errs.

    python experiments/tour_zones.py FOLDER [--csv FILE]

FOLDER is that of `+experiment=tour`, or of one run. Of each drive through a zone it takes the
motion from door to door, and says how far the estimated one ends from the true one: the root mean
square over drives and seeds [m].
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.evaluation.association import covered, interpolated
from sceneslam.sources.simulator.places.floor import BuildingLayout
from sceneslam.sources.simulator.shot import floor_plan
from sceneslam.types import se3
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import TRUTH_GAP_S

_SHORTEST_S = 2.0  # of a drive through a zone; shorter: a corner of the next one


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    errors: dict[str, dict[str, list[float]]] = {}  # zone -> strategy -> of each drive through it
    for run in sorted(path.parent for path in options.folder.rglob("groundtruth.tum")):
        strategy = run.parent.name if run != options.folder else "run"
        for zone, error_m in drives(run):
            errors.setdefault(zone, {}).setdefault(strategy, []).append(error_m)
    if not errors:
        raise SystemExit(f"{options.folder}: expected runs with groundtruth.tum, found none")
    strategies = list(dict.fromkeys(name for of in errors.values() for name in of))
    rows: list[list[str]] = [["zone", *(name.replace("_", " ") for name in strategies)]]
    for zone, of in errors.items():
        rows.append([zone, *(_shown(of.get(name, [])) for name in strategies)])
    csv.writer(sys.stdout, lineterminator="\n").writerows(rows)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)


def drives(run: Path) -> Iterator[tuple[str, float]]:
    """Yield zone and error [m] of every drive through a zone; NaN without a pose at a door."""
    truth = Trajectory.read_tum(run / "groundtruth.tum")
    estimate = Trajectory.read_tum(run / "trajectory.tum")
    names = _zones(truth, floor_plan("building", _order(run)))
    edges = [0, *(np.flatnonzero(names[1:] != names[:-1]) + 1).tolist(), len(names) - 1]
    for first, last in pairwise(edges):
        span_ns = truth.stamps_ns[[first, last]]
        if names[first] and span_ns[1] - span_ns[0] >= _SHORTEST_S * 1e9:
            yield str(names[first]), _error_m(estimate, truth, span_ns)


def _order(run: Path) -> int | None:
    """Return the seed of the order of rooms that a run had."""
    from omegaconf import OmegaConf

    config: Any = OmegaConf.load(run / "config.yaml")
    order = (config.get("configuration") or config).source.order
    return None if order is None else int(order)


def _zones(truth: Trajectory, plan: BuildingLayout) -> Any:
    at = truth.T_world_base[:, :2, 3].tolist()
    held = [next((zone.name for zone in plan.zones if zone.holds(*xy)), "") for xy in at]
    return np.array(held)


def _error_m(estimate: Trajectory, truth: Trajectory, span_ns: Any) -> float:
    if len(covered(estimate, span_ns, TRUTH_GAP_S)) < 2:
        return float("nan")
    told, true = (interpolated(one, span_ns).T_world_base for one in (estimate, truth))
    T_told, T_true = (se3.inverse(poses[0]) @ poses[1] for poses in (told, true))
    return float(np.linalg.norm(T_told[:3, 3] - T_true[:3, 3]))


def _shown(errors_m: list[float]) -> str:
    known = np.array([error_m for error_m in errors_m if not np.isnan(error_m)])
    return f"{np.sqrt(np.mean(known**2)):.2f}" if len(known) else "-"


if __name__ == "__main__":
    main()
