"""Runs an experiment: a component, named by the key `experiment`, that asks for many runs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from sceneslam.app import run
from sceneslam.config.build import make_source
from sceneslam.config.check import check_given, first_line
from sceneslam.config.component import Builder
from sceneslam.config.overlay import command_of, comment_of
from sceneslam.config.provenance import provenance, save_config
from sceneslam.config.resolve import resolved
from sceneslam.config.settings import DETECT_ONLY
from sceneslam.detection.run import detect
from sceneslam.evaluation.verdict import write_verdict
from sceneslam.evaluation.verdict_page import Asked, Ran, write_verdict_page
from sceneslam.interfaces import Experiment
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Outcome, Trial, Verdict
from sceneslam.types.trajectory import Trajectory

_END = "finished.json"  # written into a trial's folder when it has run to its end


def run_experiment(config: DictConfig, folder: Path) -> Verdict:
    """Run all trials of the experiment below the key that `experiment` names; write its verdict.

    A trial that is finished in the folder, by the same configuration, code and input, is not run
    again: an experiment that was stopped goes on where it is called for the same `hydra.run.dir`.
    Raises ConfigError or InputError where a trial cannot be run.
    """
    key = str(config.experiment)
    plain = resolved(config)
    check_given(plain.get(key), key)
    experiment = Builder(plain).make(key, Experiment)
    folder.mkdir(parents=True, exist_ok=True)
    hydra = HydraConfig.get()
    trials = _Trials(key, folder / "runs", hydra.overrides.task)
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
    """Composes and runs what an experiment asks for."""

    def __init__(self, key: str, folder: Path, overrides: Sequence[str]) -> None:
        self._key, self._folder, self._overrides = key, folder, overrides
        self.done: list[Ran] = []

    def run(self, trials: Iterable[Trial]) -> Iterator[Outcome]:
        """Yield the outcomes in order.

        Before the first is run all are composed, and each input is opened once.
        """
        configs = [(trial, self._compose(trial)) for trial in trials]
        _try_sources([config for _, config in configs])
        for trial, config in tqdm(configs, desc=self._key, unit="run", leave=False):
            folder = self._folder / trial.name
            made_by = provenance(config)
            if _finished_by(folder) != made_by:
                self._run(config, folder, trial.name, made_by)
            yield self._outcome(trial, folder, config["run"]["mode"] != DETECT_ONLY)

    def _outcome(self, trial: Trial, folder: Path, has_poses: bool) -> Outcome:
        metrics = json.loads((folder / "metrics.json").read_text())
        faults = json.loads((folder / _END).read_text())["faults"]
        self.done.append(Ran(trial=trial, folder=folder, metrics=metrics, faults=faults))
        return Outcome(
            trial=trial,
            folder=folder,
            metrics=metrics,
            trajectory=_read(folder / "trajectory.tum", has_poses),
            online=_read(folder / "trajectory_online.tum", has_poses),
            faults=faults,
        )

    def _run(
        self, config: dict[str, Any], folder: Path, name: str, made_by: dict[str, str]
    ) -> None:
        (folder / _END).unlink(missing_ok=True)
        faults: tuple[str, ...] = ()
        if config["run"]["mode"] == DETECT_ONLY:
            detect(config, folder)
        else:
            finished = run(config, folder, title=name)
            if finished.is_interrupted:
                raise KeyboardInterrupt
            faults = finished.faults
        end = {"made_by": made_by, "faults": faults}
        (folder / _END).write_text(json.dumps(end, indent=2))

    def _compose(self, trial: Trial) -> dict[str, Any]:
        """Return a trial's configuration: the user's, what it overrides, then its values."""
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
        plain = resolved(merged)
        return {
            name: value for name, value in plain.items() if name not in ("experiment", self._key)
        }


def _try_sources(configs: Iterable[Mapping[str, Any]]) -> None:
    """Raise the error of any source that cannot be opened."""
    inputs: dict[str, Mapping[str, Any]] = {}
    for config in configs:
        inputs.setdefault(
            json.dumps([config["source"], config.get("effects")], default=str), config
        )
    for config in inputs.values():
        make_source(config, Builder(config))


def _read(path: Path, is_there: bool) -> Trajectory:
    return Trajectory.read_tum(path) if is_there else Trajectory.empty()


def _finished_by(folder: Path) -> dict[str, str] | None:
    """Return what made the finished trial in a folder, None where none is finished."""
    path = folder / _END
    if not path.is_file():
        return None
    made_by: dict[str, str] = json.loads(path.read_text())["made_by"]
    return made_by
