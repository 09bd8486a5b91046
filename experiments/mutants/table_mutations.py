"""Changes of the scene -> module table, of the modules it names and of the top level."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sceneslam.experiments.mutants.mutant import Mutant, removed, renamed, replaced
from sceneslam.experiments.mutants.mutations import Subject, misspelt

_REQUIRED = ("source", "detector", "policy", "atlas", "run", "evaluation", "slam", "scenes")


def table_mutants(subject: Subject, rng: np.random.Generator) -> Iterator[Mutant]:
    """Yield the mutants of a scenario."""
    scenes, slam = subject.resolved["scenes"], subject.resolved["slam"]
    for scene, keys in scenes.items():
        yield from _of_row(subject, scene, keys, rng)
    rows = {key: [f"scenes.{scene}" for scene in scenes if key in scenes[scene]] for key in slam}
    for key in slam:
        gone = removed(subject.composed, ("slam", key))
        yield subject.mutant("module gone", f"slam.{key}", gone, *rows[key], "slam")
        nulled = replaced(subject.composed, ("slam", key), None)
        yield subject.mutant("module gone", f"slam.{key} = None", nulled, *rows[key], "slam")
        typo = misspelt(key, rng)
        config = renamed(subject.composed, ("slam", key), typo)
        yield subject.mutant("misspelt key", f"slam.{key} -> {typo}", config, *rows[key])
        for wrong in (7, "rgbd", []):
            yield subject.put("another type", ("slam", key), wrong)
    yield from _startups(subject, rng)
    yield from _of_top(subject, rng)
    yield from _valid(subject)


def _of_row(
    subject: Subject, scene: str, keys: list[str], rng: np.random.Generator
) -> Iterator[Mutant]:
    """Yield rows that are missing, empty, no list or name what is not there."""
    path = ("scenes", scene)
    name = f"scenes.{scene}"
    yield subject.mutant("scene gone", name, removed(subject.composed, path), name)
    typo = misspelt(scene, rng)
    config = renamed(subject.composed, path, typo)
    yield subject.mutant("misspelt key", f"{name} -> {typo}", config, name, f"scenes.{typo}")
    extra = replaced(subject.composed, ("scenes", f"{scene}er"), keys)
    yield subject.mutant("valid: another row", f"scenes.{scene}er", extra)  # a warning
    for value in ([], None, keys[0], 7, {keys[0]: 1}, [[keys[0]]], "???", "${nowhere}"):
        yield subject.put("bad row", path, value)
    for value in ([*keys, keys[0]], [misspelt(keys[0], rng)], [*keys, "nobody"], [None]):
        yield subject.put("bad row", path, value)


def _startups(subject: Subject, rng: np.random.Generator) -> Iterator[Mutant]:
    """Yield start-up times of modules that are not there, and that are no times."""
    key = next(iter(subject.resolved["slam"]))
    path = ("policy", "startup_s")
    for value in (-1.0, float("nan"), float("inf"), "long", None, True, [1.0]):
        config = replaced(subject.composed, path, {key: value})
        names = (f"policy.startup_s.{key}", "policy.startup_s")
        yield subject.mutant("out of range", f"{names[0]} = {value!r}", config, *names)
    typo = misspelt(key, rng)
    config = replaced(subject.composed, path, {typo: 1.0})
    name = f"policy.startup_s.{typo}"
    yield subject.mutant("misspelt key", name, config, name)
    config = replaced(subject.composed, path, {key: 1.0})
    yield subject.mutant("valid: another value", f"policy.startup_s.{key} = 1.0", config)


def _of_top(subject: Subject, rng: np.random.Generator) -> Iterator[Mutant]:
    """Yield mutants of the keys that have no component around them."""
    for key in subject.resolved:
        typo = misspelt(key, rng)
        config = renamed(subject.composed, (key,), typo)
        yield subject.mutant("misspelt key", f"{key} -> {typo}", config, *_users(key), typo)
    for key in _REQUIRED:
        scenes = [f"scenes.{scene}" for scene in subject.resolved["scenes"]]
        names = [key, *(scenes if key == "scenes" else [])]
        yield subject.mutant("missing key", key, removed(subject.composed, (key,)), *names)
        for wrong in (7, "many", [1]):
            mutant = subject.put("another type", (key,), wrong)
            yield subject.mutant(mutant.kind, mutant.change, mutant.config, *names)
    for key, wrongs in {
        "seed": (-1, "many", 0.5, [0], None, True),
        "story": ("bright_to_drak", 7, None, [1]),
        "lights": ("dim", 7, None, True),
        "allow_targets": ("mine", 7, {"a": 1}, [7]),
        "sinks": (7, "many", [1]),
        "effects": (7, "many", [1]),
    }.items():
        for wrong in wrongs:
            mutant = subject.put("wrong type or choice", (key,), wrong)
            names = [*mutant.named, *_users(key)]
            yield subject.mutant(mutant.kind, mutant.change, mutant.config, *names)
    detector = {
        **subject.resolved["detector"],
        "_target_": "sceneslam.modules.slam.odometry.Odometry",
    }
    config = replaced(subject.composed, ("detector",), detector)
    names = ["detector", *(f"detector.{name}" for name in detector)]
    yield subject.mutant("wrong target", "detector = odometry", config, *names)


def _users(key: str) -> list[str]:
    """Return the keys that refer to a value of the top level, which may be named instead."""
    parts = ("source", "effects", "slam.bright", "slam.only")
    return [key, *(f"{part}.{key}" for part in parts)]


def _valid(subject: Subject) -> Iterator[Mutant]:
    """Yield the table with fewer or other fallbacks, and other seeds."""
    for scene, keys in subject.resolved["scenes"].items():
        for row in (keys[:1], list(reversed(keys))):
            config = replaced(subject.composed, ("scenes", scene), row)
            yield subject.mutant("valid: another row", f"scenes.{scene} = {row!r}", config)
    for key, value in (("seed", 7), ("lights", "on"), ("lights", "off"), ("sinks", None)):
        config = replaced(subject.composed, (key,), value)
        yield subject.mutant("valid: another value", f"{key} = {value!r}", config)
