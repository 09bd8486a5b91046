"""Changes of a component that make no sense, and some that do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sceneslam.experiments.mutants import knowledge
from sceneslam.experiments.mutants.mutant import (
    Mutant,
    Path,
    Tree,
    at,
    dotted,
    removed,
    renamed,
    reordered,
    replaced,
    walk,
)

TARGET = "_target_"


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """A valid configuration: as composed, and with its `${...}` resolved."""

    name: str
    composed: Tree
    resolved: Tree

    def mutant(self, kind: str, change: str, config: Tree, *named: str) -> Mutant:
        """Return a mutant of this base."""
        return Mutant(
            kind=kind, base=self.name, change=change, config=config, named=frozenset(named)
        )

    def put(self, kind: str, path: Path, value: object) -> Mutant:
        """Return the mutant with another value at a path, whose key has to be named."""
        key = dotted(path)
        names = (key, dotted(path[:-1])) if isinstance(path[-1], int) else (key,)
        outer = dotted(tuple(path[: _first_index(path)]))  # a list is named as a whole
        if knowledge.is_of_a_free_table(key):  # named as a whole, too
            outer = dotted(path[:2])
        config = replaced(self.composed, path, value)
        return self.mutant(kind, f"{key} = {value!r}", config, *names, outer)


def component_mutants(subject: Subject, part: Path, rng: np.random.Generator) -> Iterator[Mutant]:
    """Yield the mutants of one component: of each key below `part`, and of itself."""
    yield from _targets(subject, part)
    node = at(subject.resolved, part)
    yield subject.put("another type", part, 7)
    yield subject.put("another type", part, [node])
    if not knowledge.may_be_null(dotted(part)):
        mutant = subject.put("null", part, None)
        names = (*mutant.named, part[0])  # `slam: got nothing` where it was the only module
        yield subject.mutant(mutant.kind, mutant.change, mutant.config, *names)
    for path in walk(at(subject.composed, part), part):  # what a `${...}` holds is changed there
        if path[-1] == TARGET:
            continue
        value = at(subject.resolved, path)
        yield from _of_key(subject, path, rng)
        yield from _of_value(subject, path, value)
        yield from _valid(subject, path, value)
    yield subject.mutant("valid: keys in another order", "all", reordered(subject.composed))


def _of_key(subject: Subject, path: Path, rng: np.random.Generator) -> Iterator[Mutant]:
    """Yield a misspelt, a missing and an additional key."""
    name, key = path[-1], dotted(path)
    if isinstance(name, int) or knowledge.is_of_a_free_table(key):
        return
    typo = misspelt(name, rng)
    config, wrong = renamed(subject.composed, path, typo), dotted((*path[:-1], typo))
    yield subject.mutant("misspelt key", f"{key} -> {typo}", config, key, wrong)
    if not _holds_optional(path):
        config = removed(subject.composed, path)
        yield subject.mutant("missing key", key, config, key)
    added = dotted((*path[:-1], f"{name}_2"))
    config = replaced(subject.composed, (*path[:-1], f"{name}_2"), 1)
    yield subject.mutant("unknown key", added, config, added)
    yield subject.put("not given", path, "???")
    yield subject.put("dead reference", path, "${nowhere}")


def _of_value(subject: Subject, path: Path, value: Any) -> Iterator[Mutant]:
    """Yield values of a wrong type and out of range."""
    key = dotted(path)
    for wrong in _wrong_types(key, value):
        yield subject.put("wrong type", path, wrong)
    if value is not None and not knowledge.may_be_null(key):
        yield subject.put("null", path, None)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number or (value is None and knowledge.is_number(key)):
        for wrong in _out_of_range(key):
            yield subject.put("out of range", path, wrong)
    if knowledge.is_choice(key) and not isinstance(value, list | dict):
        yield subject.put("unknown choice", path, "nonsense")


def _wrong_types(key: str, value: Any) -> list[Any]:
    if isinstance(value, bool):
        return ["perhaps", 7, [value]]
    if isinstance(value, int):
        return ["many", [value], {"a": value}, value + 0.5, True]
    if isinstance(value, float):
        return ["many", [value], {"a": value}, True]
    if isinstance(value, str):
        return [7, [value], {"a": value}]
    if isinstance(value, list):
        return ["many", 7, {"a": value}, [*value, {"a": 1}], [{"a": 1}]]
    if isinstance(value, dict):
        return ["many", 7, [value]]
    return [{"a": 1}, *(["many", True] if knowledge.is_number(key) else [])]


def _out_of_range(key: str) -> list[float]:
    wrong = [math.nan, math.inf, -math.inf]
    if not knowledge.may_be_negative(key):
        wrong.append(-1)
    if not knowledge.may_be_zero(key):
        wrong.append(0)
    if knowledge.is_share(key):
        wrong.append(2)
    return wrong


def _valid(subject: Subject, path: Path, value: Any) -> Iterator[Mutant]:
    """Yield a change that must not be refused."""
    if isinstance(value, bool):
        other: Any = not value
        if dotted(path).endswith("required"):  # asks for an extra
            return
    elif isinstance(value, int | float):
        other = knowledge.smaller(dotted(path), value)
    else:
        return
    config = replaced(subject.composed, path, other)
    yield subject.mutant("valid: another value", f"{dotted(path)} = {other!r}", config)


def _targets(subject: Subject, part: Path) -> Iterator[Mutant]:
    """Yield targets that do not exist, are not ours or are another part's."""
    target = at(subject.resolved, part)[TARGET]
    home, _, name = target.rpartition(".")
    wrong = (f"{home}.{name}s", f"{home}x.{name}", name, "os.system", "sceneslam", 7, None)
    other = "sceneslam.evaluation.settings.EvaluationSettings"
    if other == target:
        other = "sceneslam.atlas.atlas.Atlas"
    for value in (*wrong, other):
        mutant = subject.put("wrong target", (*part, TARGET), value)
        if value == other:  # its arguments are another's
            given = [f"{dotted(part)}.{name}" for name in at(subject.resolved, part)]
            mutant = subject.mutant(
                mutant.kind, mutant.change, mutant.config, *mutant.named, dotted(part), *given
            )
        yield mutant
    config = removed(subject.composed, (*part, TARGET))
    yield subject.mutant("missing key", dotted((*part, TARGET)), config, dotted(part))


def misspelt(name: str, rng: np.random.Generator) -> str:
    """Return a name with two neighbouring letters swapped, or one missing."""
    places = [place for place in range(len(name) - 1) if name[place] != name[place + 1]]
    if rng.random() < 0.5 and places:
        place = int(rng.choice(places))
        return f"{name[:place]}{name[place + 1]}{name[place]}{name[place + 2 :]}"
    place = int(rng.integers(len(name)))
    return f"{name[:place]}{name[place + 1 :]}" or f"{name}_"


def _first_index(path: Path) -> int:
    return next((at for at, step in enumerate(path) if isinstance(step, int)), len(path))


def _holds_optional(path: Path) -> bool:
    """Tell whether a key may be left out: the tables of a recording's topics and camera."""
    return path[:2] in (("source", "topics"), ("source", "camera")) and len(path) == 3
