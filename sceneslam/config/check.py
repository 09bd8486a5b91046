"""Checks of a configuration before anything is built; errors name the full key."""

from __future__ import annotations

import difflib
import inspect
import math
import pkgutil
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

from sceneslam.types.errors import ConfigError, text_of
from sceneslam.types.input_files import given_path
from sceneslam.types.run import Command

OWN_PREFIX = "sceneslam."
NOT_GIVEN = "???"  # a value that the user has to set
TOP_LEVEL = (
    "allow_targets",
    "atlas",
    "detector",
    "effects",
    "evaluation",
    "experiment",
    "jobs",
    "lights",
    "policy",
    "reference",
    "run",
    "scenes",
    "seed",
    "sinks",
    "slam",
    "source",
    "story",
)
_LONGEST_BYTES = 200  # of a module's key: the name of its trajectory's file may have 255


_MOST = {  # largest plausible values by unit; larger ones overflow or never end
    "s": 1e9,  # 32 years; 64 bits hold 292 years of nanoseconds
    "m": 1e8,  # more than twice around the Earth
    "deg": 1e4,
    "rad": 1e4,
    "hz": 1e6,
    "px": 1e6,
    "mb": 1e7,
    "count": 1e6,
}


_CHANGES = ("effects", "exposure_times", "failing_sensor", "faulty", "laps", "spoilt_odometry")
_MOVED = {  # modules of targets that a run's `config.yaml`, or one of a user's, may still name
    "sceneslam.bus.bayes_filter": "sceneslam.bus.scene.bayes_filter",
    "sceneslam.bus.gate": "sceneslam.bus.judging.gate",
    **{f"sceneslam.sources.{name}": f"sceneslam.sources.changes.{name}" for name in _CHANGES},
}


class _Nothing:
    """Placeholder in error messages for a value that was not given."""

    def __repr__(self) -> str:
        return "nothing"


NOTHING = _Nothing()


def check_keys(config: Mapping[str, Any]) -> None:
    """Raise ConfigError for an unknown top-level key, or what `check_given` refuses.

    So are keys of `slam` that cannot be in the name of a file, such as that of a trajectory.
    """
    check_given(config, "")
    for key in config:
        if key not in TOP_LEVEL:
            close = difflib.get_close_matches(key, (*TOP_LEVEL, "scenario", "experiment"), n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise ConfigError(key, config[key], f"{', '.join(TOP_LEVEL)}{hint}")
    modules = config.get("slam")
    for key in modules if isinstance(modules, Mapping) else ():
        if {"/", "\\"} & set(key) or not key.isprintable() or len(key.encode()) > _LONGEST_BYTES:
            allowed = (
                f"a key that can be in the name of a file, at most {_LONGEST_BYTES} bytes long"
            )
            raise ConfigError("slam", key, f"{allowed}, without / and \\")


def check_maps_apart(runs: Iterable[Mapping[str, Any]]) -> None:
    """Raise ConfigError if two runs save a map in one folder: that of the first would be lost.

    `runs` are the tables `atlas` of the runs. A map that a run loads is not lost where it saves.
    """
    taken: set[Path] = set()
    for atlas in runs:
        save = map_folder(atlas, "save")
        if save is None or save == map_folder(atlas, "load"):
            continue
        if save in taken:
            allowed = "a folder of its own for every run, or the one in atlas.load"
            raise ConfigError("atlas.save", atlas["save"], allowed)
        taken.add(save)


def check_no_reference(config: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError if a configuration asks for a reference where none is compared."""
    if config.get("reference"):
        raise ConfigError("reference", config["reference"], f"null {where}")


def map_folder(atlas: Mapping[str, Any], key: str) -> Path | None:
    """Return the folder that `load` or `save` of a table `atlas` names; None: null."""
    path = atlas.get(key)
    return None if path is None else given_path(str(path)).resolve()


def check_node(node: object, key: str, *, allow: Sequence[str], positional: int = 0) -> None:
    """Raise ConfigError if a component's node does not fit the signature of its `_target_`.

    `allow` are the prefixes outside of our package that the user trusts, since a `_target_` is
    code. `positional` arguments are passed by the builder and must not be in the node.
    """
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise ConfigError(key, node, "a component: `_target_` and its arguments")
    target = locate(node["_target_"], f"{key}._target_", allow)
    for name in node:
        if name.startswith("_") and name != "_target_":
            raise ConfigError(f"{key}.{name}", node[name], "no key of Hydra's but _target_")
    arguments = {name: value for name, value in node.items() if name != "_target_"}
    parameters = list(inspect.signature(target).parameters.values())[positional:]
    names = [parameter.name for parameter in parameters]
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    for name, value in arguments.items():
        if name not in names and not takes_any:
            raise ConfigError(f"{key}.{name}", value, f"one of {', '.join(names) or 'nothing'}")
    for parameter in parameters:
        is_required = parameter.default is parameter.empty and parameter.kind in (
            parameter.POSITIONAL_OR_KEYWORD,
            parameter.KEYWORD_ONLY,
        )
        if is_required and parameter.name not in arguments:
            raise ConfigError(f"{key}.{parameter.name}", NOTHING, "a value; it has no default")
    hints = hints_of(target)
    for name, value in arguments.items():
        if not _check_inner(value, f"{key}.{name}", allow):
            continue
        if name in hints and not fits(value, hints[name]):
            raise ConfigError(f"{key}.{name}", value, describe(hints[name]))
        is_command = Command in (hints.get(name), *typing.get_args(hints.get(name)))
        if is_command and isinstance(value, list) and not set(value[:1]) <= set(allow):
            allowed = f"a program that the command line allows: allow_targets=[{value[0]}]"
            raise ConfigError(f"{key}.{name}", value, allowed)


def _check_inner(value: object, key: str, allow: Sequence[str]) -> bool:
    """Check components at any depth of a value; return whether it is itself a plain value."""
    if isinstance(value, Mapping):
        if "_target_" in value:
            check_node(value, key, allow=allow)
            return False
        for name, item in value.items():
            _check_inner(item, f"{key}.{name}", allow)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            _check_inner(item, f"{key}[{index}]", allow)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        _check_number(value, key)
    return True


def _check_number(value: float, key: str) -> None:
    """Raise ConfigError for a number that is implausible for the key's unit."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(key, value, "a finite number")
    unit = re.search(r"_([a-z]+)(\[\d+\])*$", key)
    most = _MOST.get(unit[1]) if unit else None
    if most is not None and abs(value) > most:
        raise ConfigError(key, value, f"at most {most:g} in either direction")


def hints_of(target: Callable[..., object]) -> dict[str, Any]:
    """Return the types of a target's arguments, empty if unknown at run time."""
    try:
        return typing.get_type_hints(target.__init__ if inspect.isclass(target) else target)
    except (NameError, TypeError):
        return {}


def check_given(value: object, key: str) -> None:
    """Raise ConfigError for a key that is not text, or a value not given (`???`), at any depth."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            if not isinstance(name, str):
                allowed = "keys that are text, in quotes if necessary; decimals have a point"
                raise ConfigError(key or "the configuration", name, allowed)
            check_given(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            check_given(item, f"{key}[{index}]")
    elif value == NOT_GIVEN:
        raise ConfigError(key, NOTHING, f"a value, as in {key}=...")


def locate(target: object, key: str, allow: Sequence[str]) -> Callable[..., object]:
    """Return the class or function of a `_target_`; raises ConfigError if it is not allowed.

    Only classes of our own package are components: a function could build other targets without
    these checks.
    """
    prefixes = (OWN_PREFIX, *(f"{prefix.rstrip('.')}." for prefix in allow))
    if not isinstance(target, str) or not target.startswith(prefixes):
        where = f"a name under {' or '.join(prefixes)}"
        raise ConfigError(key, target, f"{where} ({_how_to_allow(str(target))})")
    module, _, name = target.rpartition(".")
    try:
        found = pkgutil.resolve_name(f"{_MOVED.get(module, module)}.{name}")
    except (Exception, SystemExit) as error:
        reason = first_line(error)
        raise ConfigError(key, target, f"a class that can be imported ({reason})") from error
    if not inspect.isclass(found) and not inspect.isfunction(found):
        raise ConfigError(key, target, "a class or a function")
    home = f"{found.__module__}."  # an allowed module may import the name from elsewhere
    if not home.startswith(prefixes):
        raise ConfigError(key, target, f"what is defined under {' or '.join(prefixes)}")
    if home.startswith(OWN_PREFIX) and not inspect.isclass(found):
        raise ConfigError(key, target, f"a class under {OWN_PREFIX}, which builds itself")
    return typing.cast("Callable[..., object]", found)


def _how_to_allow(target: str) -> str:
    """Return how to allow one's own code; libraries are not proposed."""
    package = target.partition(".")[0]
    is_own = package.isidentifier() and package not in sys.stdlib_module_names
    if is_own and package not in packages_distributions():
        return f"a target is code: allow your own on the command line, allow_targets=[{package}]"
    return "a target is code: only packages that the command line names in allow_targets are run"


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message; a program's exit code has its type before it."""
    said = text_of(error) if isinstance(error, SystemExit) else str(error)
    return next(iter(said.strip().splitlines()), type(error).__name__)


def fits(value: object, hint: Any) -> bool:
    """Tell whether a value, or a built part, fits an argument's annotation.

    Unknown hints accept all values.
    """
    if value == NOT_GIVEN:
        return True  # reported by `check_given`
    hint = getattr(hint, "__supertype__", hint)
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, part) for part in typing.get_args(hint))
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (str, bool) or hint is type(None):
        return isinstance(value, hint)
    if hint is Path:
        return isinstance(value, str)
    if origin in (list, tuple, Sequence):
        return isinstance(value, list) and _items_fit(value, origin, typing.get_args(hint))
    if origin in (dict, Mapping):
        part = typing.get_args(hint)[1]
        return isinstance(value, dict) and all(fits(item, part) for item in value.values())
    if origin is typing.Literal:
        return value in typing.get_args(hint)
    if getattr(hint, "_is_protocol", False):
        return not missing_members(value, hint)
    return hint is Any or not inspect.isclass(hint) or isinstance(value, hint)


def missing_members(part: object, kind: type) -> list[str]:
    """Return the public members of a Protocol or class that a part does not have."""
    has = dir(part)
    return [name for name in vars(kind) if not name.startswith("_") and name not in has]


def _items_fit(value: list[object], origin: Any, parts: tuple[Any, ...]) -> bool:
    if origin is tuple and not (len(parts) == 2 and parts[1] is Ellipsis):
        return len(value) == len(parts) and all(map(fits, value, parts))
    return all(fits(item, parts[0]) for item in value)


_WORDS = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "true or false",
    Any: "any value",
    type(None): "null",
    Path: "a path",
}


def describe(hint: Any) -> str:
    """Return a text on the values that an annotation accepts."""
    hint = getattr(hint, "__supertype__", hint)
    if hint in _WORDS:
        return _WORDS[hint]
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(describe(part) for part in parts)
    if origin is tuple and Ellipsis not in parts:
        return f"a list of {len(parts)}: {', '.join(describe(part) for part in parts)}"
    if origin in (list, tuple, Sequence):
        return f"a list, each {describe(parts[0])}"
    if origin in (dict, Mapping):
        return f"a table, each value {describe(parts[1])}"
    return f"a {hint.__name__}" if inspect.isclass(hint) else str(hint)
