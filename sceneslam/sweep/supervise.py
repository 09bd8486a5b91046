"""Running of a job in a process of its own, so that a crash does not affect other jobs."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import BinaryIO

from sceneslam.collect.status import State, Status
from sceneslam.supervision.ending import how_it_ended

_LOOK_S = 0.2  # interval of checks for a stop of the sweep
_PATIENCE_S = 30.0  # for a stopped job to save its results
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOrder:
    """A job with all data to run it, on any machine with access to the folders."""

    folder: Path
    code: Path  # a copy of the package as it was when the sweep began
    began_in: Path  # working folder of the sweep: base of relative paths
    stop: Path  # the sweep stops when this file exists
    cores: int | None = None  # cores for the job; None: all


def run_job(order: JobOrder) -> None:
    """Run a job to its end; its final state is always in its folder."""
    if order.stop.exists():
        settle(order.folder, State.STOPPED, "stopped before it began")
        return
    began_s = perf_counter()
    with (order.folder / "job.log").open("wb") as log, _start(order, log) as process:
        _wait(process, order.stop)
    died = State.STOPPED if order.stop.exists() else State.KILLED
    settle(order.folder, died, f"its process {how_it_ended(process.returncode)}; see job.log")
    ended = Status.read(order.folder) or Status(state=died)
    replace(ended, wall_s=perf_counter() - began_s).write(order.folder)


def settle(folder: Path, state: State, error: str) -> None:
    """Write the final state of a job that has not written one itself."""
    status = Status.read(folder) or Status(state=State.WAITING)
    if not status.is_settled:
        status.now(state, error).write(folder)


def _start(order: JobOrder, log: BinaryIO) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "sceneslam.sweep.job", str(order.folder)],
        stdin=subprocess.PIPE,  # closed at the end of this process, which ends the job
        stdout=log,
        stderr=subprocess.STDOUT,
        cwd=order.began_in,
        env=_environment(order),
        start_new_session=True,  # Ctrl-C is handled by the sweep
    )


def _wait(process: subprocess.Popen[bytes], stop: Path) -> None:
    """Wait for a job's end; terminate it if the sweep stops."""
    left_s: float | None = None
    while True:
        try:
            process.wait(_LOOK_S)
            return
        except subprocess.TimeoutExpired:
            if left_s is not None:
                left_s -= _LOOK_S
                if left_s < 0:
                    process.kill()
            elif stop.exists():
                left_s = _PATIENCE_S
                process.terminate()


def _environment(order: JobOrder) -> dict[str, str]:
    """Return a job's environment: the copied code first, and one thread per library.

    Parallel jobs are faster than parallel threads, and with more threads BLAS adds in another
    order.
    """
    before = os.environ.get("PYTHONPATH")
    path = [str(order.code), str(order.began_in), *([before] if before else [])]
    threads = {name: os.environ.get(name, "1") for name in _THREADS}
    cores = {} if order.cores is None else {"SCENESLAM_CORES": str(order.cores)}
    return {**os.environ, **threads, **cores, "PYTHONPATH": os.pathsep.join(path)}
