"""Execution of experiments: components, named by the key `experiment`, that need many runs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, cast

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from sceneslam.app import run
from sceneslam.config.build import opened_source
from sceneslam.config.check import check_given, check_maps_apart, check_no_reference, first_line
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.overlay import command_of, comment_of, typed_words
from sceneslam.config.provenance import files_written, provenance, save_config
from sceneslam.config.resolve import resolved
from sceneslam.config.settings import DETECT_ONLY
from sceneslam.config.words import check_trust
from sceneslam.detection.run import detect
from sceneslam.evaluation.report.verdict_page import Asked, Ran, write_verdict_page
from sceneslam.evaluation.shortfalls import NO_POSE
from sceneslam.evaluation.verdict import write_verdict
from sceneslam.interfaces import Experiment
from sceneslam.interrupts import terminate_with
from sceneslam.leaving import leave_threads
from sceneslam.types.errors import ConfigError, InputError
from sceneslam.types.experiment import Trial, TrialResult, Verdict
from sceneslam.types.files import replacing
from sceneslam.types.ranges import check_least
from sceneslam.types.trajectory import Trajectory

_END = "finished.json"  # written to a trial's folder when it is finished
_READ = ("metrics.json", "trajectory.tum", "trajectory_online.tum")  # of a finished trial


def run_experiment(config: DictConfig, folder: Path) -> Verdict:
    """Run all trials of the experiment at the key that `experiment` names; write its verdict.

    A trial that is already finished with the same configuration, code and input is not run again:
    an experiment that was stopped continues if it is called with the same `hydra.run.dir`. One with
    other errors than those of its input, such as of a full disk or memory, is run again. Raises
    ConfigError or InputError if a trial cannot be run.
    """
    key = str(config.experiment)
    plain = resolved(config)
    check_given(plain.get(key), key)
    jobs = plain.get("jobs")
    if not isinstance(jobs, int) or isinstance(jobs, bool):
        raise ConfigError("jobs", jobs, "a whole number")
    check_least(1, jobs=jobs)
    experiment = ComponentBuilder(plain).make(key, Experiment)
    folder.mkdir(parents=True, exist_ok=True)
    hydra = HydraConfig.get()
    with tqdm(desc=key, unit="run", leave=False) as bar:
        trials = _Trials(key, folder / "runs", typed_words(hydra.overrides.task), jobs, bar)
        verdict = experiment.run(trials.run, folder)
    write_verdict(folder, key, verdict)
    save_config(plain, folder / "config.yaml")
    asked = Asked(
        name=str(hydra.runtime.choices.get("experiment") or key),
        question=comment_of(hydra, "experiment"),
        command=command_of(hydra),
        config_yaml=(folder / "config.yaml").read_text(),
    )
    write_verdict_page(folder, asked, verdict, trials.done)
    return verdict


class _Trials:
    """Composes and runs the trials of an experiment."""

    def __init__(
        self, key: str, folder: Path, overrides: Sequence[str], jobs: int, bar: Any
    ) -> None:
        self._key, self._folder, self._overrides, self._jobs = key, folder, overrides, jobs
        self._bar = bar  # over all runs, as some experiments request them one by one
        self._atlases: dict[str, Mapping[str, Any]] = {}  # by the name of the trial
        self.done: list[Ran] = []

    def run(self, trials: Iterable[Trial]) -> Iterator[TrialResult]:
        """Yield the results in order.

        Before the first run, all are composed, and each input is opened once. With several `jobs`,
        this number runs in parallel, each in a process of its own.
        """
        configs = [(trial, self._compose(trial)) for trial in trials]
        self._atlases |= {trial.name: config.get("atlas") or {} for trial, config in configs}
        check_maps_apart(self._atlases.values())
        _try_sources([config for _, config in configs])
        self._bar.total = self._bar.n + len(configs)
        for (trial, config), _ in zip(configs, self._made(configs), strict=True):
            self._bar.update()
            folder = self._folder / trial.name
            yield self._outcome(trial, folder, config["run"]["mode"] != DETECT_ONLY)

    def _made(self, configs: Sequence[tuple[Trial, dict[str, Any]]]) -> Iterator[None]:
        """Execute the runs in order; yield after each."""
        folders = [self._folder / trial.name for trial, _ in configs]
        if self._jobs == 1:
            for (trial, config), folder in zip(configs, folders, strict=True):
                _run_unless_finished(config, folder, trial.name)
                yield
            return
        context = get_context("spawn")  # libraries with threads do not survive a fork
        reader, writer = context.Pipe(duplex=False)
        pool = ProcessPoolExecutor(self._jobs, context, initializer=_end_with, initargs=(reader,))
        with reader, writer, pool:
            # A source is rendered once. Effects are left to the runs: they note what struck.
            inputs = {
                _input_of(bare := config | {"effects": None}): bare
                for (_, config), folder in zip(configs, folders, strict=True)
                if _finished_by(folder) != provenance(config)
            }
            try:
                for _ in pool.map(_prepare, inputs.values()):
                    pass
                names = [trial.name for trial, _ in configs]
                plain = [config for _, config in configs]
                yield from pool.map(_run_beside, plain, folders, names)
            except BaseException as error:
                writer.close()
                pool.shutdown(wait=False, cancel_futures=True)
                if isinstance(error, BrokenProcessPool):
                    cause = f"it was killed, or jobs={self._jobs} need too much memory"
                    raise InputError(
                        f"a trial's process ended ({cause}): {self._folder}"
                    ) from error
                raise

    def _outcome(self, trial: Trial, folder: Path, has_poses: bool) -> TrialResult:
        metrics = json.loads((folder / "metrics.json").read_text())
        faults = json.loads((folder / _END).read_text())["faults"]
        self.done.append(Ran(trial=trial, folder=folder, metrics=metrics, faults=faults))
        return TrialResult(
            trial=trial,
            folder=folder,
            metrics=metrics,
            trajectory=_read(folder / "trajectory.tum", has_poses),
            online=_read(folder / "trajectory_online.tum", has_poses),
            faults=faults,
        )

    def _compose(self, trial: Trial) -> dict[str, Any]:
        """Return a trial's configuration: the user's, with the trial's overrides and values."""
        try:
            config = compose("config", overrides=[*self._overrides, *trial.overrides])
        except HydraException as error:
            allowed = f"overrides that compose ({first_line(error)})"
            raise ConfigError(self._key, list(trial.overrides), allowed) from error
        try:
            merged = cast(DictConfig, OmegaConf.merge(config, dict(trial.values)))
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(self._key, trial.name, f"values that fit ({reason})") from error
        check_trust(merged, self._overrides)
        plain = resolved(merged)
        check_no_reference(plain, "in an experiment: it compares the runs of its own")
        return {
            name: value for name, value in plain.items() if name not in ("experiment", self._key)
        }


def _end_with(pipe: Connection) -> None:
    """Let a process that runs trials end when the experiment closes the pipe or was killed."""
    terminate_with(os.dup(pipe.fileno()))
    Finalize(None, leave_threads, args=(0,), exitpriority=0)  # before it waits for its threads


def _run_beside(config: dict[str, Any], folder: Path, name: str) -> None:
    """Run a trial; a process whose run is interrupted ends, and takes no other one."""
    try:
        _run_unless_finished(config, folder, name)
    except KeyboardInterrupt:
        os._exit(1)


def _run_unless_finished(config: dict[str, Any], folder: Path, name: str) -> None:
    """Run a configuration, unless the same one is finished in the folder."""
    made_by = provenance(config)
    if _finished_by(folder) == made_by:
        return
    for earlier in (folder / _END, *files_written(config)):
        earlier.unlink(missing_ok=True)
    faults: tuple[str, ...] = ()
    is_final, is_stop_requested = True, False
    if config["run"]["mode"] == DETECT_ONLY:
        faults = detect(config, folder)
        is_final = not faults
    else:
        finished = run(config, folder, title=name)
        if finished.is_interrupted:
            raise KeyboardInterrupt(f"stopped during the trial {name}")
        faults, is_stop_requested = finished.faults, finished.is_stop_requested
        is_final = all(one in finished.input_faults or one.startswith(NO_POSE) for one in faults)
        if lost := [one for one in _READ if not (folder / one).is_file()]:
            raise InputError(f"{lost[0]} of a trial is missing: {'; '.join(faults)}: {folder}")
    end = {"made_by": made_by, "faults": faults, "is_final": is_final}
    with replacing(folder / _END) as file:
        file.write(json.dumps(end, indent=2))
    if is_stop_requested:
        raise KeyboardInterrupt(f"stopped after the trial {name}")


def _prepare(config: dict[str, Any]) -> None:
    """Read the first observation, for which the simulator renders and caches its whole story."""
    with opened_source(config, ComponentBuilder(config)) as source:
        next(iter(source), None)


def _try_sources(configs: Iterable[Mapping[str, Any]]) -> None:
    """Raise the error of a source that cannot be opened."""
    for config in {_input_of(config): config for config in configs}.values():
        with opened_source(config, ComponentBuilder(config)):
            pass


def _input_of(config: Mapping[str, Any]) -> str:
    return json.dumps([config["source"], config.get("effects")], default=str)


def _read(path: Path, is_there: bool) -> Trajectory:
    return Trajectory.read_tum(path) if is_there else Trajectory.empty()


def _finished_by(folder: Path) -> dict[str, str] | None:
    """Return the provenance of the finished trial in a folder; None: it is to be run again."""
    path = folder / _END
    if not path.is_file():
        return None
    end = json.loads(path.read_text())
    made_by: dict[str, str] = end["made_by"]
    return made_by if end.get("is_final", True) else None
