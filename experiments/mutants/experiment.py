"""The experiment `mutants`: mistakes in the shipped configurations, before the first frame.

`conf/experiment/mutants.yaml` says how it is called, `experiments/mutants.md` what was found.
"""

from __future__ import annotations

import csv
import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sceneslam.config.build import build
from sceneslam.config.check import check_given
from sceneslam.config.component import ComponentBuilder
from sceneslam.config.resolve import composed, resolved
from sceneslam.experiments.mutants.bases import Base, bases
from sceneslam.experiments.mutants.combinations import combinations
from sceneslam.experiments.mutants.mutant import Mutant
from sceneslam.experiments.mutants.mutations import Subject, component_mutants
from sceneslam.experiments.mutants.recordings import write_recordings
from sceneslam.experiments.mutants.table_mutations import table_mutants
from sceneslam.interfaces import Experiment
from sceneslam.types.errors import ConfigError
from sceneslam.types.experiment import Figure, Relation, RunTrials, Table, Verdict
from sceneslam.types.ranges import check_between, check_least


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What became of one mutant."""

    mutant: Mutant
    said: str  # the error's sentence, "" where it was accepted
    is_right: bool  # refused by the right key, or valid and accepted


class MutantsExperiment:
    """Puts every mutant through all that happens before the first frame."""

    def __init__(
        self, *, seed: int, sample: int | None, mutants_min: int, refused_min: float
    ) -> None:
        check_least(0, seed=seed, mutants_min=mutants_min)
        check_between(0, 100, refused_min=refused_min)
        if sample is not None and sample < 1:
            raise ConfigError("sample", sample, "1 or more, or null: all")
        self._seed, self._sample = seed, sample
        self._mutants_min, self._refused_min = mutants_min, refused_min

    def run(self, run_trials: RunTrials, folder: Path) -> Verdict:
        """Build every mutant; no trial is run, since none is to come so far."""
        data = (folder / "recordings").resolve()
        write_recordings(data)
        mutants = list(all_mutants(data, self._seed))
        if self._sample is not None and self._sample < len(mutants):
            drawn = np.random.default_rng(self._seed).permutation(len(mutants))[: self._sample]
            mutants = [mutants[index] for index in sorted(drawn)]
        with _quiet():
            findings = [judged(mutant) for mutant in tqdm(mutants, desc="mutants", unit="mutant")]
        _write(folder / "slipped.csv", [one for one in findings if not one.is_right])
        return Verdict(figures=self._figures(findings), table=_table(findings))

    def _figures(self, findings: Sequence[Finding]) -> list[Figure]:
        wrong = [one for one in findings if one.mutant.named]
        valid = [one for one in findings if not one.mutant.named]
        named = sum(one.is_right for one in wrong)
        return [
            Figure(
                name="mutants",
                value=float(len(wrong)),
                relation=Relation.AT_LEAST,
                bound=float(self._mutants_min),
            ),
            Figure(
                name="mutants refused before the first frame, the right key named",
                value=100.0 * named / max(len(wrong), 1),
                relation=Relation.AT_LEAST,
                bound=self._refused_min,
                unit="%",
            ),
            Figure(
                name="valid configurations refused",
                value=float(sum(not one.is_right for one in valid)),
                relation=Relation.AT_MOST,
                bound=0.0,
            ),
        ]


def all_mutants(data: Path, seed: int) -> Iterator[Mutant]:
    """Yield the mutants of all shipped configurations, which read the recordings of `data`."""
    rng = np.random.default_rng(seed)
    for base in bases(data):
        subject = _subject(base)
        yield subject.mutant("valid: as shipped", base.name, subject.composed)
        if base.part:
            yield from component_mutants(subject, tuple(base.part.split(".")), rng)
        else:
            yield from table_mutants(subject, rng)
    for one in combinations(data):
        yield Mutant(
            kind="sensors missing" if one.named else "valid: other options",
            base="combination",
            change=" ".join(one.overrides[1:]),
            config=composed(one.overrides),
            named=one.named,
        )


def _subject(base: Base) -> Subject:
    tree = composed(base.overrides)
    return Subject(name=base.name, composed=tree, resolved=resolved(tree))


def judged(mutant: Mutant) -> Finding:
    """Return what is said of a mutant before the first frame."""
    try:
        _make(resolved(mutant.config))
    except ConfigError as error:
        is_right = error.key in mutant.named
        return Finding(mutant=mutant, said=str(error), is_right=is_right)
    except Exception as error:  # anything else is a traceback, or a sentence without a key
        return Finding(mutant=mutant, said=f"{type(error).__name__}: {error}", is_right=False)
    return Finding(mutant=mutant, said="", is_right=not mutant.named)


def _make(config: dict[str, Any]) -> None:
    """Build what a run, or an experiment, is made of."""
    key = config.get("experiment")
    if key is None:
        build(config).close()
        return
    check_given(config.get(key), key)
    ComponentBuilder(config).make(key, Experiment)


@contextmanager
def _quiet() -> Iterator[None]:
    """Hold back warnings: a valid mutant may deserve some."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def _write(path: Path, findings: Sequence[Finding]) -> None:
    """Write what slipped through, to be looked at."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("base", "kind", "change", "said"))
        for one in findings:
            writer.writerow((one.mutant.base, one.mutant.kind, one.mutant.change, one.said))


def _table(findings: Sequence[Finding]) -> Table:
    """Return one row per kind."""
    all_of = Counter(one.mutant.kind for one in findings)
    right = Counter(one.mutant.kind for one in findings if one.is_right)
    accepted = Counter(one.mutant.kind for one in findings if not one.said)
    kinds = sorted(all_of, key=lambda kind: (kind.startswith("valid"), kind))
    rows: list[tuple[str, float, float, float]] = [
        (kind, all_of[kind], accepted[kind], right[kind]) for kind in kinds
    ]
    return Table(columns=("kind", "mutants", "accepted", "right"), rows=rows)
