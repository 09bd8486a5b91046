"""Backends that run the jobs of a sweep, each job in a process of its own."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from time import sleep
from typing import Any, Protocol

from sceneslam.collect.status import State, Status
from sceneslam.config.check import first_line
from sceneslam.interrupts import termination_noted
from sceneslam.sweep.supervise import JobOrder, run_job, settle
from sceneslam.types.errors import ConfigError

_LOOK_S = 0.2


class Backend(Protocol):
    """Runs jobs; if a job or its worker dies, this is recorded in the job's folder."""

    def run(self, orders: Sequence[JobOrder]) -> None:
        """Run all jobs; return when all have ended."""
        ...


class Basic:
    """Runs one job after the other, on this machine."""

    def run(self, orders: Sequence[JobOrder]) -> None:
        """Run the jobs in order."""
        for order in orders:
            run_job(order)


class Joblib:
    """Runs several jobs at a time, on this machine."""

    def __init__(self, n_jobs: int, cpus_per_job: int) -> None:
        if not isinstance(n_jobs, int) or n_jobs == 0:
            raise ConfigError("n_jobs", n_jobs, "1 or more; -1: one per core")
        _check_count("cpus_per_job", cpus_per_job)
        self._n_jobs, self._cpus_per_job = n_jobs, cpus_per_job

    def run(self, orders: Sequence[JobOrder]) -> None:
        """Run the jobs in threads; each thread waits for its job's process."""
        try:
            from joblib import Parallel, delayed
        except ImportError as error:
            raise _missing("joblib", "sweep", error) from error

        parallel = Parallel(n_jobs=self._n_jobs, backend="threading", batch_size=1)
        prepared = _with_cores(orders, self._cpus_per_job)
        parallel(delayed(run_job)(order) for order in prepared)


class Submitit:
    """Runs jobs on a SLURM cluster, or on submitit's local replacement.

    `array_parallelism` jobs run at a time; `parameters` are submitit's own (`timeout_min`,
    `cpus_per_task`, `slurm_partition`, ...).
    """

    def __init__(
        self, cluster: str, array_parallelism: int | None, parameters: Mapping[str, Any]
    ) -> None:
        if cluster not in ("local", "slurm"):
            raise ConfigError("cluster", cluster, "local | slurm")
        if array_parallelism is not None:
            _check_count("array_parallelism", array_parallelism)
        if not isinstance(parameters, Mapping):
            raise ConfigError("parameters", parameters, "a table of submitit's parameters")
        self._cluster = cluster
        self._at_once = array_parallelism or _cores()
        self._parameters = dict(parameters)

    def run(self, orders: Sequence[JobOrder]) -> None:
        """Submit the jobs: to SLURM as one array, else as cores are free."""
        try:
            from submitit import AutoExecutor
        except ImportError as error:
            raise _missing("submitit", "sweep", error) from error

        try:
            executor = AutoExecutor(orders[0].stop.parent / "submitit", cluster=self._cluster)
        except RuntimeError as error:  # no such cluster
            raise ConfigError(
                "hydra.launcher.cluster", self._cluster, f"one that answers ({error})"
            ) from error
        try:
            executor.update_parameters(**self._parameters)
        except (NameError, TypeError, ValueError) as error:
            key = "hydra.launcher.parameters"
            raise ConfigError(key, self._parameters, f"submitit's ({error})") from error
        prepared = _with_cores(orders, self._parameters.get("cpus_per_task") or 1)
        waiting, running = deque(prepared), dict[JobOrder, Any]()
        if self._cluster == "slurm":
            executor.update_parameters(slurm_array_parallelism=self._at_once)
            running = dict(zip(prepared, executor.map_array(run_job, prepared), strict=True))
            waiting.clear()
        while waiting or running:
            while waiting and len(running) < self._at_once:
                order = waiting.popleft()
                running[order] = executor.submit(run_job, order)
            for order, job in list(running.items()):
                if job.done():
                    del running[order]
                    _note(order, job.result)
                elif order.stop.exists() and _is_waiting(order):
                    running.pop(order).cancel()  # it may be queued for long
            sleep(_LOOK_S)


class Ray:
    """Runs jobs as tasks of a Ray cluster; without an address, one is started on this machine."""

    def __init__(self, address: str | None, num_cpus: int | None, cpus_per_job: float) -> None:
        if not isinstance(cpus_per_job, int | float) or not cpus_per_job > 0:
            raise ConfigError("cpus_per_job", cpus_per_job, "above 0")
        if num_cpus is not None:
            _check_count("num_cpus", num_cpus)
        self._address, self._num_cpus = address, num_cpus
        self._cpus_per_job = cpus_per_job

    def run(self, orders: Sequence[JobOrder]) -> None:
        """Run the jobs as cores are free; if a worker dies, only its own job fails."""
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError as error:
            raise _missing("ray", "ray", error) from error

        num_cpus = None if self._address else self._num_cpus or _cores()
        try:
            ray.init(self._address, num_cpus=num_cpus, include_dashboard=False, log_to_driver=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            reason = f"a Ray cluster that answers; null: one of its own ({first_line(error)})"
            raise ConfigError("hydra.launcher.address", self._address, reason) from error
        with termination_noted(orders[0].stop.touch), ExitStack() as opened:  # Ray's own ends us
            opened.callback(ray.shutdown)
            task = ray.remote(num_cpus=self._cpus_per_job, max_retries=0)(run_job)
            prepared = _with_cores(orders, int(self._cpus_per_job))
            running = {task.remote(order): order for order in prepared}
            while running:
                ended, _ = ray.wait(list(running))
                for reference in ended:
                    _note(running.pop(reference), partial(ray.get, reference))


def _check_count(name: str, value: object) -> None:
    if not isinstance(value, int) or value < 1:
        raise ConfigError(name, value, "1 or more")


def _cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _with_cores(orders: Sequence[JobOrder], cores: int) -> Sequence[JobOrder]:
    return [replace(order, cores=max(1, cores)) for order in orders]


def _is_waiting(order: JobOrder) -> bool:
    status = Status.read(order.folder)
    return status is None or status.state is State.WAITING


def _note(order: JobOrder, result: Callable[[], object]) -> None:
    """Record in the job's folder if its worker died."""
    try:
        result()
    except Exception as error:
        reason = str(error).strip().splitlines() or [""]
        settle(order.folder, State.KILLED, f"its worker died: {type(error).__name__}: {reason[0]}")


def _missing(package: str, extra: str, error: ImportError) -> ConfigError:
    return ConfigError(
        "hydra/launcher", package, f"an installed one: pip install 'sceneslam[{extra}]' ({error})"
    )


BACKENDS: Mapping[str, type[Any]] = {
    "basic": Basic,
    "joblib": Joblib,
    "submitit": Submitit,
    "ray": Ray,
}
