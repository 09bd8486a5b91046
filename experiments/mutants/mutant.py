"""A configuration with one change, and where the change was made."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

Tree = dict[str, Any]
Path = tuple[str | int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One change of a valid configuration."""

    kind: str
    base: str
    change: str  # in words
    config: Tree
    named: frozenset[str]  # keys, one of which has to be named; empty: the mutant is valid


def dotted(path: Path) -> str:
    """Return a path as a message writes it: `source.exposure.range_s[0]`."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def at(tree: Any, path: Path) -> Any:
    """Return what stands at a path."""
    for step in path:
        tree = tree[step]
    return tree


def changed(tree: Tree, path: Path, change: Callable[[Any, Any], None]) -> Tree:
    """Return a copy in which `change` was called with what holds the path's last step, and it."""
    twin = copy.deepcopy(tree)
    change(at(twin, path[:-1]), path[-1])
    return twin


def replaced(tree: Tree, path: Path, value: object) -> Tree:
    """Return a copy with another value at a path."""
    return changed(tree, path, lambda holder, step: holder.__setitem__(step, value))


def removed(tree: Tree, path: Path) -> Tree:
    """Return a copy without what stands at a path."""
    return changed(tree, path, lambda holder, step: holder.pop(step))


def renamed(tree: Tree, path: Path, name: str) -> Tree:
    """Return a copy with another key at a path, in the same place."""
    twin = copy.deepcopy(tree)
    holder = at(twin, path[:-1])
    items = list(holder.items())
    holder.clear()
    holder.update((name if key == path[-1] else key, value) for key, value in items)
    return twin


def reordered(tree: Any) -> Any:
    """Return a copy with the keys of every table in reverse; lists keep their order."""
    if isinstance(tree, dict):
        return {key: reordered(value) for key, value in reversed(tree.items())}
    return copy.deepcopy(tree)


def walk(tree: Any, path: Path = ()) -> Iterator[Path]:
    """Yield the path of everything below a tree, tables and lists before what they hold."""
    steps: Any = tree if isinstance(tree, dict) else range(len(tree) if type(tree) is list else 0)
    for step in steps:
        yield (*path, step)
        yield from walk(tree[step], (*path, step))
