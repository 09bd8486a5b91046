"""The experiment `tune`: values that serve an objective best, checked on recordings held out.

`conf/experiment/tune.yaml` says how it is called, `experiments/tune/README.md` what was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from sceneslam.experiments.tune.figure import draw_search
from sceneslam.experiments.tune.objective import Objective
from sceneslam.experiments.tune.overlay import write_overlay
from sceneslam.experiments.tune.space import read_space
from sceneslam.experiments.tune.study import Drawn, Search
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, RunTrials, Table, Trial, TrialResult, Verdict
from sceneslam.types.ranges import check_least, check_some

Outcomes = Mapping[str, TrialResult]  # by recording


class TuneExperiment:
    """Searches on some recordings, and holds the winner against the defaults on others, too.

    `train` and `held_out`: name of a recording -> the overrides that select it.
    """

    def __init__(
        self,
        *,
        space: Mapping[str, Mapping[str, Any]],
        objective: Objective,
        train: Mapping[str, Sequence[str]],
        held_out: Mapping[str, Sequence[str]],
        trials: int,
        seed: int,
    ) -> None:
        check_least(1, trials=trials)
        check_least(0, seed=seed)
        check_some(train=train, held_out=held_out)
        for name in set(train) & set(held_out):
            raise ConfigError(f"held_out.{name}", name, "a recording that is not in train")
        self._space, self._objective = read_space(space), objective
        self._splits = {"train": train, "held out": held_out}
        self._trials, self._seed = trials, seed

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Search, then run default and winner on all recordings; write the winner's overlay."""
        about = f"{self._objective.weights} {self._splits['train']}"
        search = Search(folder, self._space, seed=self._seed, about=about)
        score = partial(self._try, run_trials)
        search.run(1, score)  # a key that is misspelt is found before anything else is run ...
        defaults = self._run(run_trials, "default", {})  # ... a recording before the search
        search.run(self._trials, score)
        tuned = self._run(run_trials, "tuned", search.best)
        scores = {split: self._scores(split, defaults, tuned) for split in self._splits}
        draw_search(folder / "search.png", search.scores, default=scores["train"][0])
        write_overlay(folder / "conf" / "experiment" / "tuned.yaml", search.best, scores)
        return Verdict(
            figures=[
                Figure.at_most(f"{split}: score of the tuned, and of the default", tuned_, default)
                for split, (default, tuned_) in scores.items()
            ],
            table=self._table(defaults, tuned),
            pictures={"search.png": "The score of every trial, and the best so far."},
        )

    def _try(self, run_trials: RunTrials, number: int, drawn: Drawn) -> float:
        """Return the mean score of some values on the recordings to learn from."""
        recordings = self._splits["train"]
        trials = [_trial(f"trial_{number:03d}", *one, drawn) for one in recordings.items()]
        return fmean(self._objective.of(outcome) for outcome in run_trials(trials))

    def _run(self, run_trials: RunTrials, name: str, drawn: Drawn) -> Outcomes:
        both = {**self._splits["train"], **self._splits["held out"]}
        outcomes = run_trials([_trial(name, *one, drawn) for one in both.items()])
        return dict(zip(both, outcomes, strict=True))

    def _scores(self, split: str, *strategies: Outcomes) -> Sequence[float]:
        names = self._splits[split]
        return [fmean(self._objective.of(runs[name]) for name in names) for runs in strategies]

    def _table(self, defaults: Outcomes, tuned: Outcomes) -> Table:
        metrics = list(self._objective.weights)
        rows = [
            (
                split,
                name,
                *(self._objective.of(runs[name]) for runs in (defaults, tuned)),
                *(self._objective.value(r[name], m) for m in metrics for r in (defaults, tuned)),
            )
            for split, recordings in self._splits.items()
            for name in recordings
        ]
        both = [f"{name}, {which}" for name in metrics for which in ("default", "tuned")]
        columns = ("split", "recording", "score, default", "score, tuned", *both)
        return Table(columns=columns, rows=rows)


def _trial(name: str, recording: str, overrides: Sequence[str], drawn: Drawn) -> Trial:
    values = [f"{key}={str(value).lower()}" for key, value in drawn.items()]
    return Trial(name=f"{name}/{recording}", overrides=(*overrides, *values))
