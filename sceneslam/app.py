"""Carries a run out: builds the parts, feeds the bus, saves what came of it, whatever happens."""

from __future__ import annotations

import ctypes
import gc
import resource
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from sceneslam.atlas.save import save_map
from sceneslam.atlas.uncertainty import write_covariances
from sceneslam.config.build import Parts, build
from sceneslam.config.provenance import save_config
from sceneslam.evaluation.metrics import Metrics, evaluate, write_metrics
from sceneslam.evaluation.report import write_report
from sceneslam.interrupts import termination_as_interrupt, uninterrupted
from sceneslam.loop import Loop
from sceneslam.types.errors import told
from sceneslam.types.trajectory import Trajectory

_WRITTEN = (
    "trajectory*.tum",
    "trajectory_covariance.txt",
    "groundtruth.tum",
    "figures/*.png",
    "map/*",
    "metrics.json",
    "report.html",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """A run that ended, one way or another; its folder is written."""

    metrics: Metrics
    trajectory: Trajectory
    faults: tuple[str, ...]  # what was wrong with the input or ended the run early
    is_interrupted: bool  # by Ctrl-C or SIGTERM


def run(
    config: Mapping[str, Any],
    folder: Path,
    *,
    title: str = "sceneslam",
    reference: Trajectory | None = None,
) -> Finished:
    """Run a resolved configuration and write its folder.

    Raises ConfigError or InputError where nothing could be run. What ends a run once it has begun
    (Ctrl-C, broken input, no module left) is in `faults`, and all that was computed is saved.
    """
    _reclaim()
    with closing(build(config)) as parts:
        folder = folder.resolve()  # a module may leave the working directory
        folder.mkdir(parents=True, exist_ok=True)
        _clear(folder)
        cv2.setNumThreads(parts.run.threads)
        loop = Loop(parts, folder, title)
        with termination_as_interrupt():
            loop.run()
            with uninterrupted():
                loop.close()
                return _save(config, parts, folder, loop, title, reference)


def _reclaim() -> None:
    """Give back what the run before this one left in the process: cycles, and freed images."""
    gc.collect()
    with suppress(OSError, AttributeError):  # only glibc keeps freed memory, and can be asked
        ctypes.CDLL(None).malloc_trim(0)


def _clear(folder: Path) -> None:
    """Remove what an earlier run left in the folder, so that nothing old stands beside the new."""
    for pattern in _WRITTEN:
        for path in folder.glob(pattern):
            path.unlink()


def _peak_rss_mb() -> float:
    """Return the most memory of this process and, added, of the largest that it started."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(resource.getrusage(one).ru_maxrss for one in who) / 1024


def _save(
    config: Mapping[str, Any],
    parts: Parts,
    folder: Path,
    loop: Loop,
    title: str,
    reference: Trajectory | None,
) -> Finished:
    """Write the run's folder, what matters most first; what cannot be written is a fault."""
    result, truth = loop.result(), loop.truth
    with _noting(loop.faults, "the trajectories"):
        result.trajectory.write_tum(folder / "trajectory.tum")
        result.online.write_tum(folder / "trajectory_online.tum")
        if truth is not None and len(truth.trajectory):
            truth.trajectory.write_tum(folder / "groundtruth.tum")
        for session in result.sessions:
            name = f"trajectory_{session.index}_{session.module}.tum"
            session.trajectory.write_tum(folder / name)
        write_covariances(
            folder / "trajectory_covariance.txt",
            result.trajectory.stamps_ns,
            result.covariances,
        )
    with _noting(loop.faults, "the map"):
        save_map(result.map, folder / "map")
    metrics = evaluate(
        result,
        truth,
        settings=parts.evaluation,
        peak_rss_mb=_peak_rss_mb(),
        reference=reference,
    )
    with _noting(loop.faults, "configuration, metrics and report"):
        versions = save_config(config, folder / "config.yaml")
        write_metrics(folder / "metrics.json", metrics)
        if parts.run.report:
            write_report(
                folder,
                result,
                truth,
                metrics,
                title=title,
                config=config,
                threshold=parts.threshold,
                config_yaml=(folder / "config.yaml").read_text(),
                versions=versions,
                faults=loop.faults,
                reference=reference,
                value_label=parts.detector.quantity,
            )
    return Finished(
        metrics=metrics,
        trajectory=result.trajectory,
        faults=tuple(loop.faults),
        is_interrupted=loop.is_interrupted,
    )


@contextmanager
def _noting(faults: list[str], what: str) -> Iterator[None]:
    """Note what a full disk or the like keeps from being saved, and go on with the rest."""
    try:
        yield
    except OSError as error:
        faults.append(f"{what} could not all be saved: {told(error)}")
