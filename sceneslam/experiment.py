"""Runs an experiment: a component, named by the key `experiment`, that asks for many runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from sceneslam.app import run
from sceneslam.config.check import check_given
from sceneslam.config.component import Builder
from sceneslam.config.resolve import resolved
from sceneslam.evaluation.verdict import write_verdict
from sceneslam.interfaces import Experiment
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Outcome, Trial, Verdict
from sceneslam.types.trajectory import Trajectory


def run_experiment(config: DictConfig, folder: Path) -> Verdict:
    """Run all trials of the experiment below the key that `experiment` names; write its verdict.

    Raises ConfigError or InputError where a trial cannot be run.
    """
    key = str(config.experiment)
    plain = resolved(config)
    check_given(plain.get(key), key)
    experiment = Builder(plain).make(key, Experiment)
    folder.mkdir(parents=True, exist_ok=True)
    trials = _Trials(key, folder / "runs", HydraConfig.get().overrides.task)
    verdict = experiment.run(trials.run, folder)
    write_verdict(folder, key, verdict)
    return verdict


class _Trials:
    """Composes and runs what an experiment asks for."""

    def __init__(self, key: str, folder: Path, overrides: Sequence[str]) -> None:
        self._key, self._folder, self._overrides = key, folder, overrides

    def run(self, trials: Iterable[Trial]) -> Iterator[Outcome]:
        """Yield the outcomes in order; all trials are composed before the first is run."""
        configs = [(trial, self._compose(trial)) for trial in trials]
        for trial, config in tqdm(configs, desc=self._key, unit="run", leave=False):
            folder = self._folder / trial.name
            finished = run(config, folder, title=trial.name)
            if finished.is_interrupted:
                raise KeyboardInterrupt
            yield Outcome(
                trial=trial,
                folder=folder,
                metrics=finished.metrics,
                trajectory=finished.trajectory,
                online=Trajectory.read_tum(folder / "trajectory_online.tum"),
                faults=finished.faults,
            )

    def _compose(self, trial: Trial) -> dict[str, Any]:
        """Return a trial's configuration: the user's, what it overrides, then its values."""
        config = compose("config", overrides=[*self._overrides, *trial.overrides])
        try:
            merged = cast(DictConfig, OmegaConf.merge(config, dict(trial.values)))
        except OmegaConfBaseException as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(self._key, trial.name, f"values that fit ({reason})") from error
        plain = resolved(merged)
        return {
            name: value for name, value in plain.items() if name not in ("experiment", self._key)
        }
