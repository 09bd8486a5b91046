"""Readable names of modules: `rgbd (bright)` for the key `bright`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from sceneslam.types.run import Event, RunResult

_OURS = "sceneslam.modules.slam."
_NAMING = ("module", "from", "to", "active")  # keys of events whose value is a module's key


def module_names(slam: Mapping[str, Any]) -> dict[str, str]:
    """Return a name for each key of `slam`: the module's type, and its key if that differs."""
    return {key: _name(key, node or {}) for key, node in slam.items()}


def renamed(result: RunResult, names: Mapping[str, str]) -> RunResult:
    """Return a run's result with its modules renamed, for figures."""
    hybrid = result.map
    return replace(
        result,
        modules=[names.get(key, key) for key in result.modules],
        sessions=[replace(s, module=names.get(s.module, s.module)) for s in result.sessions],
        map=replace(hybrid, modules=tuple(names.get(key, key) for key in hybrid.modules)),
        events=[_renamed(event, names) for event in result.events],
        moments=[
            replace(one, events=[_renamed(event, names) for event in one.events])
            for one in result.moments
        ],
    )


def _name(key: str, node: Mapping[str, Any]) -> str:
    target = str(node.get("_target_", ""))
    kind = target.removeprefix(_OURS).partition(".")[0]
    if not target.startswith(_OURS):
        kind = target.rpartition(".")[2]
    return f"{kind} ({key})" if kind and kind != key else key


def _renamed(event: Event, names: Mapping[str, str]) -> Event:
    renamed = {
        key: names[event[key]]
        for key in _NAMING
        if isinstance(event.get(key), str) and event[key] in names
    }
    return {**event, **renamed} if renamed else event
