"""Runs of single modules over recordings, and the drift of each module over time."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sceneslam.evaluation.association import covered, interpolated
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text
from sceneslam.types.observation import TrackingStatus
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import TRUTH_GAP_S

STEP_S = 0.1  # between the instants that are labelled
_SPAN_S = 2.0  # motions are compared over the paper's confirmation window
_LEVER_M = 1.0  # lever arm that converts errors of rotation to position
_LOST_MPS = 1.0  # drift of a lost module: more than that of any tracking module
_VARIANCES = (1, 7, 12)  # columns of trajectory_covariance.txt: xx, yy, zz


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModuleRun:
    """A run of one module over a recording."""

    module: str  # its key in `slam`
    folder: Path
    config: Mapping[str, Any]
    estimate: Trajectory  # T_map_base
    truth: Trajectory | None  # T_gt_base

    @property
    def recording(self) -> str:
        """Return an identifier of the recording: the source with its effects, as text."""
        return json.dumps([self.config["source"], self.config.get("effects")], sort_keys=True)

    @property
    def first_ns(self) -> int:
        """Return the stamp of the first observation: poses may begin later, votes do not."""
        first_pose_ns = int(self.estimate.stamps_ns[0])
        votes_ns = (int(one["stamp_ns"]) for one in self._events() if one["event"] == "vote")
        return min(first_pose_ns, next(votes_ns, first_pose_ns))

    def drift_mps(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the drift (N,) [m/s]: growth of its error around each stamp.

        It is computed by the ground truth or, without it, by the growth of the module's variance.
        It is 1 m/s while the module is lost, and NaN where the ground truth does not cover it.
        """
        half_ns = round(_SPAN_S / 2 * 1e9)
        first_ns, last_ns = self.estimate.stamps_ns[[0, -1]]
        before_ns = np.clip(stamps_ns - half_ns, first_ns, last_ns)
        after_ns = np.clip(stamps_ns + half_ns, first_ns, last_ns)
        grown_m = (
            self._growth(before_ns, after_ns)
            if self.truth is None
            else self._errors(self.truth, before_ns, after_ns)
        )
        drift_mps = grown_m / np.maximum((after_ns - before_ns) * 1e-9, STEP_S)
        is_absent = (stamps_ns < first_ns) | (stamps_ns > last_ns)
        return np.where(is_absent | self._is_lost(stamps_ns), _LOST_MPS, drift_mps)

    def _errors(
        self, truth: Trajectory, before_ns: NDArray[np.int64], after_ns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the errors (N,) [m] of the motions between pairs of stamps, NaN without truth."""
        known = np.intersect1d(
            covered(truth, before_ns, TRUTH_GAP_S), covered(truth, after_ns, TRUTH_GAP_S)
        )
        errors_m = np.full(len(before_ns), np.nan)
        before_ns, after_ns = before_ns[known], after_ns[known]
        T_estimated, T_true = (
            se3.inverse(interpolated(one, before_ns).T_world_base)
            @ interpolated(one, after_ns).T_world_base
            for one in (self.estimate, truth)
        )
        T_error = se3.inverse(T_true) @ T_estimated
        turned_m = _LEVER_M * se3.rotation_angle_rad(T_error)
        errors_m[known] = np.linalg.norm(T_error[:, :3, 3], axis=1) + turned_m
        return errors_m

    def _growth(
        self, before_ns: NDArray[np.int64], after_ns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the growth (N,) [m] of the position's standard deviation between two stamps.

        Raises InputError for a module that reports no covariances.
        """
        path = self.folder / "trajectory_covariance.txt"
        lines = read_text(path).splitlines() if path.is_file() else []
        if all(line.startswith("#") for line in lines):
            raise InputError(f"run: it has neither ground truth nor covariances: {self.folder}")
        rows = np.loadtxt(lines, ndmin=2)
        stamps_s, variances_m2 = rows[:, 0], rows[:, _VARIANCES].sum(axis=1)
        before_m2, after_m2 = (
            np.interp(at_ns * 1e-9, stamps_s, variances_m2) for at_ns in (before_ns, after_ns)
        )
        return np.asarray(np.sqrt(np.maximum(after_m2 - before_m2, 0.0)))

    def _is_lost(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return (N,) whether the module's last status was LOST."""
        changes = [event for event in self._events() if event["event"] == "tracking"]
        is_lost = np.array([False, *(_is_lost(event) for event in changes)])
        turns_ns = np.array([event["stamp_ns"] for event in changes], np.int64)
        return np.asarray(is_lost[np.searchsorted(turns_ns, stamps_ns, side="right")])

    def _events(self) -> Iterator[Mapping[str, Any]]:
        with (self.folder / "events.jsonl").open() as file:
            for line in file:
                yield json.loads(line)


def read_runs(folders: Sequence[Path]) -> list[ModuleRun]:
    """Return the runs in and below some folders.

    Raises InputError if there is no run, or a run's table has several modules.
    """
    found = [path.parent for folder in folders for path in sorted(folder.rglob("trajectory.tum"))]
    if not found:
        raise InputError(f"runs: no finished run in {', '.join(map(str, folders))}")
    return [_read(folder) for folder in found]


def _read(folder: Path) -> ModuleRun:
    try:
        config = yaml.safe_load((folder / "config.yaml").read_text())
        modules = {key for keys in config["scenes"].values() for key in keys}
    except (OSError, KeyError, AttributeError, TypeError, yaml.YAMLError) as error:
        raise InputError(f"run: its config.yaml cannot be read: {folder}") from error
    if len(modules) != 1:
        allowed = "one module, the only one in its table `scenes`"
        raise InputError(f"run: got {', '.join(sorted(modules))}, allowed: {allowed}: {folder}")
    estimate = Trajectory.read_tum(folder / "trajectory.tum")
    if len(estimate) < 2:
        raise InputError(f"run: its trajectory has fewer than two poses: {folder}")
    truth_file = folder / "groundtruth.tum"
    truth = Trajectory.read_tum(truth_file) if truth_file.is_file() else None
    return ModuleRun(
        module=modules.pop(),
        folder=folder,
        config=config,
        estimate=estimate,
        truth=truth if truth is not None and len(truth) > 1 else None,
    )


def _is_lost(event: Mapping[str, Any]) -> bool:
    return bool(event["status"] == TrackingStatus.LOST.value)
