"""Builds one component of a configuration from its `_target_`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, cast

from hydra.errors import InstantiationException
from hydra.utils import instantiate

from sceneslam.config.check import NOTHING, check_node, first_line
from sceneslam.types.errors import ConfigError, SceneSlamError

Part = TypeVar("Part")


class Builder:
    """Makes single components of one configuration."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        self._config = config
        allow = config.get("allow_targets") or []
        if not isinstance(allow, list) or not all(isinstance(item, str) for item in allow):
            raise ConfigError("allow_targets", allow, "a list of package names")
        self._allow = allow

    def make(self, key: str, kind: type[Part], *arguments: object) -> Part:
        """Return the component at a dotted key; it must have all members of `kind`."""
        node: Any = self._config
        for name in key.split("."):
            node = node.get(name) if isinstance(node, Mapping) else None
        if node is None:
            raise ConfigError(key, NOTHING, "a component: `_target_` and its arguments")
        check_node(node, key, allow=self._allow, positional=len(arguments))
        part = self._instantiate(node, key, arguments)
        missing = [name for name in _members(kind) if name not in dir(part)]
        if missing:
            needs = f"a {kind.__name__}, which has: {', '.join(missing)}"
            raise ConfigError(key, node["_target_"], needs)
        return cast(Part, part)

    def _instantiate(
        self, node: Mapping[str, Any], key: str, arguments: tuple[object, ...]
    ) -> object:
        try:
            return instantiate(node, *arguments, _convert_="all")
        except InstantiationException as error:
            cause = error.__cause__
            if isinstance(cause, ConfigError):
                raise cause.under(key) from error
            if isinstance(cause, SceneSlamError):
                raise cause from error
            reason = first_line(cause or error)
            raise ConfigError(key, node["_target_"], f"a target that builds ({reason})") from error


def _members(kind: type) -> list[str]:
    """Return the public names that a Protocol or class asks for."""
    return [name for name in vars(kind) if not name.startswith("_")]
