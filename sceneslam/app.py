"""Execution of a run: builds the parts, feeds the bus, and saves the results in any case."""

from __future__ import annotations

import ctypes
import gc
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from sceneslam.config.build import RunParts, build
from sceneslam.config.provenance import save_config
from sceneslam.evaluation.metrics import Metrics
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.interrupts import StopRequests, stop_raised, stop_requests
from sceneslam.loop import RunLoop
from sceneslam.results import Results, reset_peak_rss
from sceneslam.storage.folder import RunFolder, give_back
from sceneslam.types.errors import ConfigError, SceneSlamError, text_of
from sceneslam.types.maps import HybridMap
from sceneslam.types.trajectory import Trajectory
from sceneslam.types.truth import GroundTruth

_log = logging.getLogger(__name__)
_ANSWER = (
    "the results are being saved; Ctrl-C again ends the run without them "
    "(its poses are kept for python -m sceneslam.recover %s)"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Finished:
    """A finished run, whose folder is written."""

    folder: Path
    metrics: Metrics
    trajectory: Trajectory  # T_map_base: `stamps_ns` (N,), `T_world_base` (N, 4, 4)
    modules: Sequence[str]  # per pose: key of its module, "" if bridged
    map: HybridMap
    truth: GroundTruth | None
    faults: tuple[str, ...]  # errors of the input, or why the run ended early
    input_faults: tuple[str, ...]  # those of them that the input will give again
    is_interrupted: bool  # by Ctrl-C or SIGTERM
    is_stop_requested: bool  # by one of them, also while the results were saved

    def __repr__(self) -> str:
        """Return the run in a few lines, as the command line prints it."""
        return "\n".join([*summary_lines(self.metrics), f"results  {self.folder}"])


def run(
    config: Mapping[str, Any],
    folder: Path,
    *,
    title: str = "sceneslam",
    reference: Trajectory | None = None,
    say: Callable[[str], None] | None = None,
) -> Finished:
    """Run a resolved configuration and write its folder; `say` receives the survey's warnings.

    Raises ConfigError or InputError if nothing could be run. The reason for an early end (Ctrl-C,
    damaged input, no module left) is in `faults`, and all results so far are saved. Raises
    KeyboardInterrupt if Ctrl-C is pressed twice while they are saved; the journal remains then.
    """
    _reclaim()
    reset_peak_rss()
    with ExitStack() as opened:
        with stop_raised():
            parts = opened.enter_context(closing(build(config)))
            folder = folder.resolve()  # a module may leave the working directory
            opened.enter_context(closing(RunFolder.claim(folder))).clear()
            cv2.setNumThreads(parts.run.threads)
            try:
                results = _begin(config, parts, folder, title)
                loop = RunLoop(parts, results, say)
            except SceneSlamError:
                give_back(folder)
                raise
        requests = opened.enter_context(stop_requests(lambda: _log.warning(_ANSWER, folder)))
        with suppress(KeyboardInterrupt):  # after the last observation
            loop.run(lambda: requests.is_any)
            requests.end_run()
        try:
            return _end(loop, results, reference, requests)
        except KeyboardInterrupt:
            loop.close(is_saved=False)
            raise KeyboardInterrupt(_unsaved(folder)) from None


def _begin(config: Mapping[str, Any], parts: RunParts, folder: Path, title: str) -> Results:
    """Write the configuration, which is needed to recover an interrupted run."""
    try:
        versions = save_config(config, folder / "config.yaml")
    except OSError as error:
        allowed = f"a folder with room for the results ({text_of(error)})"
        raise ConfigError("folder", str(folder), allowed) from error
    return Results(
        folder=folder,
        config=config,
        versions=versions,
        title=title,
        evaluation=parts.evaluation,
        has_report=parts.run.report,
        value_label=parts.detector.quantity,
        faults=[],
        source=parts.source,
    )


def _end(
    loop: RunLoop, results: Results, reference: Trajectory | None, requests: StopRequests
) -> Finished:
    """Write the results, the trajectories before anything else."""
    loop.finish()
    results.save_trajectories(loop.result())
    loop.read_truth()
    loop.close_sinks()
    metrics = results.save_rest(loop.result(), loop.truth, reference=reference)
    loop.close(is_saved=not results.unsaved)
    result = loop.result()
    return Finished(
        folder=results.folder,
        metrics=metrics,
        trajectory=result.trajectory,
        modules=result.modules,
        map=result.map,
        truth=loop.truth,
        faults=tuple(results.faults),
        input_faults=() if results.source is None else tuple(results.source.faults),
        is_interrupted=loop.is_interrupted,
        is_stop_requested=loop.is_interrupted or requests.is_any,
    )


def _unsaved(folder: Path) -> str:
    """Return a sentence on what there is of a run whose saving was ended."""
    if (folder / "trajectory.tum").exists():
        left = f"the trajectory is in {folder}, not all of the rest is"
    else:
        left = f"python -m sceneslam.recover {folder} restores the poses"
    return f"stopped while the results were being saved; {left}"


def _reclaim() -> None:
    """Release memory of earlier runs in this process: reference cycles and freed images."""
    gc.collect()
    with suppress(OSError, AttributeError):  # glibc only: returns freed memory to the system
        ctypes.CDLL(None).malloc_trim(0)
