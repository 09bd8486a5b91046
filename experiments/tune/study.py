"""A search that can be stopped and taken up again, and gives the same either way."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sceneslam.experiments.tune.space import Parameter, Value
from sceneslam.types.errors import ConfigError

Drawn = Mapping[str, Value]  # key -> value


class Search:
    """Draws values by TPE (Bergstra et al., NIPS 2011); all trials are kept in `study.jsonl`.

    The draw of a trial depends on the seed and on the trials that were finished before it, not on
    when the search was started.
    """

    def __init__(self, folder: Path, space: Sequence[Parameter], *, seed: int, about: str) -> None:
        try:
            import optuna
        except ImportError as error:
            raise ConfigError(
                "_target_", "tune", "Optuna: pip install 'sceneslam[tune]'"
            ) from error
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._space, self._seed = space, seed
        storage = JournalStorage(JournalFileBackend(str(folder / "study.jsonl")))
        self._study = optuna.create_study(study_name="tune", storage=storage, load_if_exists=True)
        self._check(json.dumps([about, [asdict(one) for one in space]]))
        for stopped in self._trials("RUNNING"):
            self._study.tell(stopped.number, state=optuna.trial.TrialState.FAIL)

    @property
    def scores(self) -> Sequence[float]:
        """Return the scores of the finished trials, in order."""
        return [float(trial.value) for trial in self._trials("COMPLETE")]

    @property
    def best(self) -> Drawn:
        """Return the values with the smallest score; of equals the first."""
        first = min(self._trials("COMPLETE"), key=lambda trial: (trial.value, trial.number))
        return dict(first.user_attrs["values"])

    def run(self, trials: int, score: Callable[[int, Drawn], float]) -> None:
        """Search on until so many trials are finished; `score` takes a number and the values."""
        while (number := len(self.scores)) < trials:
            self._study.sampler = self._sampler(number)
            draw = self._study.ask()
            values = {one.key: one.draw(draw) for one in self._space}
            draw.set_user_attr("values", values)
            self._study.tell(draw, score(number, values))

    def _sampler(self, number: int) -> Any:
        from optuna.samplers import TPESampler

        seed = self._seed * 1_000_003 + number
        return TPESampler(seed=seed, multivariate=True)

    def _trials(self, state: str) -> list[Any]:
        from optuna.trial import TrialState

        return self._study.get_trials(deepcopy=False, states=(TrialState[state],))

    def _check(self, about: str) -> None:
        """Raise ConfigError where the folder holds another search."""
        before = self._study.user_attrs.get("about")
        if before is None or not self.scores:
            self._study.set_user_attr("about", about)
        elif before != about:
            held = "a folder with another search"
            raise ConfigError("hydra.run.dir", held, "the same search, or a new folder")
