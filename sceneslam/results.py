"""Writing of a run's results to its folder, the most important first."""

from __future__ import annotations

import logging
import resource
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sceneslam.atlas.save import save_map
from sceneslam.atlas.uncertainty import write_covariances
from sceneslam.evaluation.metrics import Metrics, evaluate, truth_of_run, write_metrics
from sceneslam.evaluation.report.run_page import write_report
from sceneslam.evaluation.settings import EvaluationSettings
from sceneslam.interfaces import Source
from sceneslam.sources.changes.wrapped import logged_ns
from sceneslam.types.errors import text_of
from sceneslam.types.maps import HybridMap
from sceneslam.types.run import RunResult
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_log = logging.getLogger(__name__)


def reset_peak_rss() -> None:
    """Let the peak memory of this process begin anew, as with each run; on Linux only."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """Data for the files of a run's results; failures are added to `faults`."""

    folder: Path
    config: Mapping[str, Any]
    versions: Mapping[str, str]
    title: str
    evaluation: EvaluationSettings
    has_report: bool
    value_label: str  # of the detector's votes, for the figures
    faults: list[str]  # errors of the run, for the report
    source: Source | None  # if it is Logged, the files of trajectories have its stamps
    unsaved: list[str] = field(default_factory=list)  # the faults of saving among them

    def save_trajectories(self, result: RunResult) -> None:
        """Write the trajectories first, as they are the most important result."""
        with self._noting("the trajectory"):
            self._write_tum(result.trajectory, "trajectory.tum")
        others = {"trajectory_online.tum": result.online}
        for session in result.sessions:
            others[f"trajectory_{session.index}_{session.module}.tum"] = session.trajectory
        for name, trajectory in others.items():
            with self._noting("the other trajectories"):
                self._write_tum(trajectory, name)
        if len(result.covariances) < len(result.trajectory):
            return  # they failed, as a fault says
        with self._noting("the covariances"):
            stamps_ns = logged_ns(self.source, result.trajectory.stamps_ns)
            order = np.argsort(stamps_ns, kind="stable")
            path = self.folder / "trajectory_covariance.txt"
            write_covariances(path, stamps_ns[order], result.covariances[order])

    def save_rest(
        self,
        result: RunResult,
        truth: GroundTruth | None,
        *,
        reference: Trajectory | None = None,
        has_costs: bool = True,
    ) -> Metrics:
        """Write map, metrics and report; return the metrics.

        Their `errors` are all sentences in `faults`.
        """
        compared = partial(
            evaluate,
            settings=self.evaluation,
            peak_rss_mb=_peak_rss_mb() if has_costs else None,
        )
        metrics: Metrics | None
        try:
            metrics = compared(result, truth, reference=reference)
            truth = truth_of_run(result, truth)
        except Exception as error:  # such as NaN in the ground truth
            _log.info("no comparison", exc_info=error)
            self.faults.append(f"no comparison with the ground truth: {text_of(error)}")
            truth, reference = None, None
            metrics = None
        with self._noting("the metrics"):
            metrics = metrics or compared(result, None)  # those of the run alone
            metrics["errors"] = list(self.faults)
            write_metrics(self.folder / "metrics.json", metrics)
        metrics = metrics or compared(_unevaluated(result), None)  # not written
        with self._noting("the ground truth"):
            if truth is not None and len(truth.trajectory):
                truth.trajectory.write_tum(self.folder / "groundtruth.tum")
        with self._noting("the map"):
            save_map(self._logged(result.map), self.folder / "map")
        if self.has_report:
            with self._noting("the report"):
                self._write_report(result, truth, metrics, reference)
        self._add_errors(metrics)
        return metrics

    def lose(self, sentence: str) -> None:
        """Record what could not be saved."""
        self.unsaved.append(sentence)
        self.faults.append(sentence)

    def _add_errors(self, metrics: Metrics) -> None:
        """Add the errors of saving what comes after the metrics, also to their file."""
        if metrics.get("errors") == self.faults:
            return
        metrics["errors"] = list(self.faults)
        path = self.folder / "metrics.json"
        if path.is_file():
            with suppress(OSError):  # such as a full disk, which is an error of the run already
                write_metrics(path, metrics)

    def _logged(self, hybrid: HybridMap) -> HybridMap:
        """Return a map with the recording's stamps of its pose graph, whose nodes stay in order."""
        graph = hybrid.pose_graph
        if graph is None:
            return hybrid
        stamps_ns = logged_ns(self.source, graph.stamps_ns)
        return replace(hybrid, pose_graph=replace(graph, stamps_ns=stamps_ns))

    def _write_tum(self, trajectory: Trajectory, name: str) -> None:
        stamps_ns = logged_ns(self.source, trajectory.stamps_ns)
        trajectory.stamped(stamps_ns).write_tum(self.folder / name)

    def _write_report(
        self,
        result: RunResult,
        truth: GroundTruth | None,
        metrics: Metrics,
        reference: Trajectory | None,
    ) -> None:
        write_report(
            self.folder,
            result,
            truth,
            metrics,
            title=self.title,
            config=self.config,
            threshold=self._drawn_threshold(),
            config_yaml=(self.folder / "config.yaml").read_text(),
            versions=self.versions,
            faults=self.faults,
            reference=reference,
            value_label=self.value_label,
        )

    def _drawn_threshold(self) -> float | None:
        """Return `evaluation.drawn_threshold`, else the detector's own, if it has one."""
        for group, key in (("evaluation", "drawn_threshold"), ("detector", "threshold")):
            value = (self.config.get(group) or {}).get(key)
            if value is not None:
                return float(value)
        return None

    @contextmanager
    def _noting(self, what: str) -> Iterator[None]:
        """Record errors of saving, such as a full disk, and continue."""
        try:
            yield
        except Exception as error:
            _log.info("%s could not all be saved", what, exc_info=error)
            sentence = f"{what} could not all be saved: {text_of(error)}"
            if sentence not in self.unsaved:  # as of a full disk, for every trajectory
                self.lose(sentence)


def _unevaluated(result: RunResult) -> RunResult:
    """Return a run of which only the observations are known: its metrics can be had in any case."""
    return RunResult(
        observed_ns=result.observed_ns,
        trajectory=Trajectory.empty(),
        online=Trajectory.empty(),
        covariances=result.covariances[:0],
        modules=(),
        sessions=(),
        map=result.map,
        events=(),
        timings=result.timings,
    )


def _peak_rss_mb() -> float:
    """Return the peak memory of this process plus that of its largest child process.

    The first is the peak since `reset_peak_rss`, on Linux. The second is over all child processes
    that have ended, also those of earlier runs in this process: the system keeps no other.
    """
    children_kb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return (_own_peak_kb() + children_kb) / 1024


def _own_peak_kb() -> int:
    with suppress(OSError, ValueError, IndexError):  # no Linux, or no /proc
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
