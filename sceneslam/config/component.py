"""Building of single components from their `_target_`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar, cast

from sceneslam.config.check import (
    NOTHING,
    check_node,
    describe,
    first_line,
    fits,
    hints_of,
    locate,
    missing_members,
)
from sceneslam.types.errors import ConfigError, SceneSlamError

Part = TypeVar("Part")


class ComponentBuilder:
    """Builds components of one configuration."""

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
        part = self._build(node, key, arguments)
        missing = missing_members(part, kind)
        if missing:
            needs = f"a {kind.__name__}, which has: {', '.join(missing)}"
            raise ConfigError(key, node["_target_"], needs)
        return cast(Part, part)

    def _build(
        self, node: Mapping[str, Any], key: str, arguments: tuple[object, ...] = ()
    ) -> object:
        """Return the object that a node's target builds; inner components are built first."""
        target = locate(node["_target_"], f"{key}._target_", self._allow)
        hints = hints_of(target)
        values = {name: value for name, value in node.items() if name != "_target_"}
        for name, value in values.items():
            values[name] = self._built(value, f"{key}.{name}")
            is_part = isinstance(value, Mapping) and "_target_" in value
            if is_part and name in hints and not fits(values[name], hints[name]):
                raise ConfigError(f"{key}.{name}", value["_target_"], describe(hints[name]))
        try:
            return target(*arguments, **values)
        except ConfigError as error:
            raise error.under(key) from error
        except SceneSlamError:
            raise
        except (Exception, SystemExit) as error:
            reason = first_line(error)
            raise ConfigError(key, node["_target_"], f"a target that builds ({reason})") from error

    def _built(self, value: Any, key: str) -> Any:
        """Return a copy of a value in which components are built."""
        if isinstance(value, Mapping):
            if "_target_" in value:
                return self._build(value, key)
            return {name: self._built(item, f"{key}.{name}") for name, item in value.items()}
        if isinstance(value, list):
            return [self._built(item, f"{key}[{index}]") for index, item in enumerate(value)]
        return value
