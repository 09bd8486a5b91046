"""Words of the command line: quoting of paths, and code that the user allows."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, cast, get_args, get_origin

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from sceneslam.config.check import hints_of, locate
from sceneslam.types.errors import ConfigError

_PATH = re.compile(r"(\+{0,2}[\w.@/]*(?:path|dir))=(.*)", re.DOTALL)
_LONGEST = 4000  # characters: Hydra takes seconds to parse twice as many
_DEEPEST = 32  # brackets
_SHOWN = 120  # characters of a word in a message
_TRUST = "allow_targets"


def is_override(word: str) -> bool:
    """Tell whether a word of the command line sets or removes a key."""
    return not word.startswith("-") and ("=" in word or word.startswith("~"))


def readable(word: str, *, is_sweep: bool) -> str:
    """Return a word that Hydra can parse: paths are quoted if necessary.

    In a sweep a comma separates values, else it is part of a path. Raises ConfigError for a word
    that would take seconds to parse.
    """
    if not is_override(word):
        return word
    _check_extent(word)
    path = _PATH.fullmatch(word)
    if path is None or (is_sweep and "," in word):
        return word
    parsed = _parsed(word)
    is_read = parsed is not None and not parsed.is_sweep_override()
    return word if is_read else f"{path[1]}={quoted(path[2])}"


def _check_extent(word: str) -> None:
    key, _, value = word.partition("=")
    if len(word) > _LONGEST:
        allowed = f"at most {_LONGEST} characters; a longer value belongs in a YAML file"
        raise ConfigError(key, f"{len(word)} characters", allowed)
    steps = ((char in "[{(") - (char in "]})") for char in value)
    if max(accumulate(steps), default=0) > _DEEPEST:
        raise ConfigError(key, shortened(value), f"brackets up to {_DEEPEST} deep")


def quoted(text: str) -> str:
    """Return text in double quotes for Hydra's grammar."""
    inner = re.sub(r'(\\*)"', r'\1\1\\"', text)
    ends = len(inner) - len(inner.rstrip("\\"))
    return f'"{inner}{ends * chr(92)}"'


def how_to_quote(word: str, reason: str) -> str:
    """Return a sentence on a word that Hydra cannot parse, with its quoted form."""
    key, equals, value = word.partition("=")
    said = f"{shortened(word)}: {shortened(reason)}"
    if not equals or len(value) > _SHOWN:
        return said
    return f"{said}; if this is text, type it in quotes: {shlex.quote(f'{key}={quoted(value)}')}"


def shortened(text: str) -> str:
    """Return the beginning of a text in one line."""
    line = " ".join(text.split())
    return line if len(line) <= _SHOWN else f"{line[:_SHOWN]}..."


def check_trust(config: DictConfig, words: Sequence[str]) -> None:
    """Raise ConfigError if `allow_targets` was changed by a file.

    A `_target_` is code. A shared file must not allow its own code: only the person who types the
    command does.
    """
    vouched = typed_targets(words)
    node = OmegaConf.select(config, _TRUST)
    given = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node
    if given != vouched:
        raise ConfigError(
            _TRUST,
            given,
            "the packages named on the command line itself; a file cannot allow its own code",
        )


def check_choices(words: Sequence[str]) -> None:
    """Raise ConfigError for several options of one group: Hydra would mix their keys."""
    for one in filter(None, map(_parsed, words)):
        value = _plain(one.value())
        if not isinstance(value, list) or len(value) < 2:
            continue
        if GlobalHydra.instance().config_loader().get_group_options(one.key_or_group):
            raise ConfigError(one.get_key_element().lstrip("+"), value, "one of them at a time")


def typed_targets(words: Sequence[str]) -> Any:
    """Return what words of the command line set `allow_targets` to, [] if none does."""
    typed = [one.value() for one in map(_parsed, words) if one and one.key_or_group == _TRUST]
    return _plain(typed[-1]) if typed else []


def named_targets(word: str | None, program: str, words: str) -> list[str]:
    """Return the names in `allow_targets=[NAME,...]`, the last of a program's `words`; [] for None.

    Raises ConfigError for another word.
    """
    if word is None:
        return []
    if not (word.startswith(f"{_TRUST}=[") and word.endswith("]")):
        raise ConfigError(program, word, f"{words}, {_TRUST}=[NAME]")
    return list(typed_targets([word]))


def takes_rows(table: object) -> bool:
    """Tell whether a table of the configuration can have more rows, under any names."""
    if not isinstance(table, DictConfig) or "_target_" in table:
        return False
    owner = table._get_parent()
    if not isinstance(owner, DictConfig) or owner._get_parent() is None:
        return bool(table._key() == "scenes")  # the others of the top level hold components
    rows = cast("dict[str, Any]", OmegaConf.to_container(table))
    return all(isinstance(row, dict | list) for row in rows.values()) or _is_by_name(table, owner)


def _is_by_name(table: DictConfig, owner: DictConfig) -> bool:
    """Tell whether a component takes a table as a mapping of names to values of one type."""
    try:
        target = locate(owner.get("_target_"), "_target_", ())
    except ConfigError:
        return False
    hint = hints_of(target).get(str(table._key()))
    return get_origin(hint) in (dict, Mapping) and Any not in get_args(hint)


def _parsed(word: str) -> Override | None:
    """Return the override of a word, None if Hydra cannot parse it."""
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(one) for one in value]
    return value.text if isinstance(value, QuotedString) else value
