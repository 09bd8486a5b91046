"""Labels of the best module over time, for training, and the scene table by these labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.scenes.examples import group_of
from sceneslam.scenes.runs import STEP_S, ModuleRun
from sceneslam.types.errors import InputError

Table = Mapping[str, Sequence[str]]  # scene -> modules, the best first


@dataclass(frozen=True, slots=True, kw_only=True)
class BestModuleSpan:
    """A time span of at most a second, in which one module was best."""

    start_s: float  # after the first observation
    end_s: float
    scene: str  # named after the module
    gain_m: float  # mean additional error of the other modules


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labelled:
    """A recording with its labels."""

    name: str
    group: str  # held out together: one path, or one simulated story
    config: Mapping[str, Any]  # of its source and effects
    spans: Sequence[BestModuleSpan]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels:
    """Labelled recordings, and the modules for each scene."""

    recordings: Sequence[Labelled]
    table: Table

    def write(self, path: Path, comment: str) -> None:
        """Write a YAML file."""
        node = {
            "table": {scene: list(modules) for scene, modules in self.table.items()},
            "recordings": [
                {
                    "name": one.name,
                    "config": dict(one.config),
                    "spans": [[s.start_s, s.end_s, s.scene, s.gain_m] for s in one.spans],
                }
                for one in self.recordings
            ],
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        text = yaml.safe_dump(node, sort_keys=False, default_flow_style=None, width=100)
        path.write_text(f"# Made by: {comment}\n{text}")

    @classmethod
    def read(cls, path: Path) -> Labels:
        """Return the labels in a file; raises InputError if it is missing or invalid."""
        if not path.is_file():
            raise InputError(f"labels not found: {path}")
        try:
            node = yaml.safe_load(path.read_text())
            recordings = [
                Labelled(
                    name=str(one["name"]),
                    group=_group(one["config"]),
                    config=dict(one["config"]),
                    spans=[
                        BestModuleSpan(
                            start_s=float(start_s),
                            end_s=float(end_s),
                            scene=str(scene),
                            gain_m=float(gain_m),
                        )
                        for start_s, end_s, scene, gain_m in one["spans"]
                    ],
                )
                for one in node["recordings"]
            ]
            return cls(recordings=recordings, table=dict(node["table"]))
        except (KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise InputError(f"not a file of labels ({type(error).__name__}): {path}") from error


def label(runs: Sequence[ModuleRun], change_m: float) -> Labels:
    """Return the labels of all recordings of the runs.

    Among all sequences of modules, the one with the smallest error is chosen; each change of module
    adds `change_m` [m]. Instants that the ground truth does not cover get no label. Raises
    InputError if a recording has one module only, or its ground truth covers no instant.
    """
    keys = sorted({run.module for run in runs})
    recordings, drifts = [], []
    for _, found in groupby(sorted(runs, key=_order), key=lambda run: run.recording):
        group = list(found)
        stamps_ns = _instants_ns(group)
        drift_mps = _drifts_mps(group, keys, stamps_ns)
        is_known = np.asarray(~np.isnan(drift_mps).any(axis=1))
        if not is_known.any():
            raise InputError(f"runs: the ground truth covers none of it: {group[0].folder}")
        best = cheapest(np.where(is_known[:, None], drift_mps * STEP_S, 0.0), change_m)
        start_s = (int(stamps_ns[0]) - min(run.first_ns for run in group)) * 1e-9
        recordings.append(_labelled(group[0], keys, best, drift_mps, start_s=start_s))
        drifts.append(np.column_stack([best, drift_mps])[is_known])
    return Labels(recordings=recordings, table=_table(keys, np.concatenate(drifts)))


def cheapest(costs: NDArray[np.float64], change: float) -> NDArray[np.int64]:
    """Return (N,) the choices with the least sum of costs (N, K) and cost of changes.

    Dynamic programming (Viterbi, 1967): the least sum up to an instant, for each last choice.
    """
    count, choices = costs.shape
    came_from = np.zeros((count, choices), np.int64)
    total = costs[0].copy()
    # Forward: keep the choice, or change from the best one at the cost of a change.
    for at in range(1, count):
        best = int(np.argmin(total))
        changes = total[best] + change < total
        came_from[at] = np.where(changes, best, np.arange(choices))
        total = np.where(changes, total[best] + change, total) + costs[at]
    # Backward: follow the stored predecessors from the best last choice.
    path = np.zeros(count, np.int64)
    path[-1] = int(np.argmin(total))
    for at in range(count - 1, 0, -1):
        path[at - 1] = came_from[at, path[at]]
    return path


def _order(run: ModuleRun) -> tuple[str, str]:
    return run.recording, run.module


def _instants_ns(group: Sequence[ModuleRun]) -> NDArray[np.int64]:
    modules = [run.module for run in group]
    if len(set(modules)) < 2 or len(set(modules)) < len(modules):
        raise InputError(
            f"runs: of each recording one run of every module, two modules or more; "
            f"got {', '.join(modules)}: {group[0].folder.parent}"
        )
    first_ns = min(int(run.estimate.stamps_ns[0]) for run in group)
    last_ns = max(int(run.estimate.stamps_ns[-1]) for run in group)
    return np.arange(first_ns, last_ns, round(STEP_S * 1e9), dtype=np.int64)


def _drifts_mps(
    group: Sequence[ModuleRun], keys: Sequence[str], stamps_ns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return (N, K) the modules' drift [m/s]; inf for a module that was not run, NaN unknown."""
    drift_mps = np.full((len(stamps_ns), len(keys)), np.inf)
    for run in group:
        drift_mps[:, keys.index(run.module)] = run.drift_mps(stamps_ns)
    return drift_mps


def _labelled(
    run: ModuleRun,
    keys: Sequence[str],
    best: NDArray[np.int64],
    drift_mps: NDArray[np.float64],
    *,
    start_s: float,
) -> Labelled:
    gains_m = _gains_mps(best, drift_mps) * STEP_S
    per_second = round(1.0 / STEP_S)
    known = np.flatnonzero(~np.isnan(drift_mps).any(axis=1))
    gaps = known - np.arange(len(known))  # the same for instants without a gap between them
    columns = (best[known], known // per_second, gaps, known)
    keyed = zip(*(column.tolist() for column in columns), strict=True)
    spans = []
    for (place, *_), found in groupby(keyed, key=lambda one: one[:3]):
        inside = [at for *_, at in found]
        spans.append(
            BestModuleSpan(
                start_s=round(start_s + inside[0] * STEP_S, 3),
                end_s=round(start_s + (inside[-1] + 1) * STEP_S, 3),
                scene=keys[place],
                gain_m=round(float(gains_m[inside].sum()), 6),
            )
        )
    return Labelled(
        name=f"{_recorded(run.config)}, {run.folder.parent.name}/{run.folder.name}",
        group=_group(run.config),
        config={key: run.config.get(key) for key in ("source", "effects")},
        spans=spans,
    )


def _recorded(config: Mapping[str, Any]) -> str:
    """Return what a source reads: its path, or the story that it simulates."""
    source = dict(config["source"])
    return str(source.get("path") or source.get("story") or source["_target_"])


def _group(config: Mapping[str, Any]) -> str:
    recorded = _recorded(config)
    return group_of(recorded) if config["source"].get("path") else recorded


def _gains_mps(best: NDArray[np.int64], drift_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N,) the mean drift [m/s] of the other modules minus the best one's, 0 or more."""
    excess_mps = drift_mps - np.take_along_axis(drift_mps, best[:, None], axis=1)
    was_run = np.isfinite(excess_mps)
    total_mps = np.where(was_run, excess_mps, 0.0).sum(axis=1)
    return np.asarray(np.maximum(total_mps / np.maximum(was_run.sum(axis=1) - 1, 1), 0.0))


def _table(keys: Sequence[str], drifts: NDArray[np.float64]) -> Table:
    """Return, for each module that was best at any time, all modules by their mean drift then."""
    best, drift_mps = drifts[:, 0].astype(int), drifts[:, 1:]
    table = {}
    for place in np.unique(best):
        means_mps = np.where(
            np.arange(len(keys)) == place, -1.0, drift_mps[best == place].mean(axis=0)
        )
        table[keys[place]] = [keys[other] for other in np.argsort(means_mps, kind="stable")]
    return table
