"""The reference, made from the configurations and the code: `pages()` maps file to Markdown."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

import yaml

from sceneslam.catalogue import GROUPS
from sceneslam.config.check import describe, hints_of

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"
_LINE = re.compile(
    r"^(?P<indent> *)(?P<key>[\w@./]+|\"\w+\"):(?: +(?P<value>[^#]*?))?(?: +#(?P<note>.*))?$"
)
_CODE = (
    ("interfaces", "What a component must do", "sceneslam.interfaces"),
    ("observation", "What the sensors saw", "sceneslam.types.observation"),
    ("rig", "What a robot carries", "sceneslam.types.rig"),
    ("maps", "What a map is made of", "sceneslam.types.maps"),
    ("truth", "What is known to be true", "sceneslam.types.truth"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """One key of a YAML file."""

    name: str  # dotted
    value: str  # as written; "" where keys below it follow
    note: str  # its comment


def pages() -> dict[str, str]:
    """Return the reference: path of each page below `reference/`, and its text."""
    found = {"config.md": _top_level()}
    found |= {f"{group}.md": _group(group) for group in GROUPS}
    return found | {f"{name}.md": _code(title, path) for name, title, path in _CODE}


def keys_of(path: Path) -> Iterator[Key]:
    """Yield all keys of a YAML file in the house's style: nested tables, a comment per key."""
    parents: list[tuple[int, str]] = []
    for line in path.read_text().splitlines():
        match = _LINE.match(line)
        if not match or line.startswith("#"):
            continue
        indent = len(match["indent"])
        parents = [parent for parent in parents if parent[0] < indent]
        parents.append((indent, match["key"].strip('"')))
        name = ".".join(key for _, key in parents)
        yield Key(name=name, value=match["value"] or "", note=(match["note"] or "").strip())


def _top_level() -> str:
    rows = _rows(CONF / "config.yaml", lambda name: not name.startswith(("hydra", "defaults")), {})
    return f"# Keys of every run\n\n{_head(CONF / 'config.yaml')}\n\n{rows}"


def _group(group: str) -> str:
    options = sorted((CONF / group).rglob("*.yaml"))
    parts = [_option(path, str(path.relative_to(CONF / group).with_suffix(""))) for path in options]
    return "\n\n".join([f"# {group}\n\n{GROUPS[group]}", *parts]) + "\n"


def _option(path: Path, name: str) -> str:
    """Return what one YAML file offers: its comment, its target's words, its keys."""
    content = yaml.safe_load(path.read_text()) or {}
    parts = [f"## {name}", _head(path)]
    based = [_based(entry) for entry in content.get("defaults", []) if entry != "_self_"]
    if based:
        parts.append(f"Based on {', '.join(based)}.")
    if "_target_" in content:
        target = _locate(content["_target_"])
        parts.append(f"`{content['_target_']}`\n\n{inspect.getdoc(target) or ''}")
    hints = dict(_hints(content, ""))
    parts.append(_rows(path, lambda key: not key.startswith(("defaults", "_target_")), hints))
    return "\n\n".join(part for part in parts if part)


def _hints(node: object, prefix: str) -> Iterator[tuple[str, object]]:
    """Yield what every key of a file's components takes, by its dotted name."""
    if not isinstance(node, dict):
        return
    if str(node.get("_target_", "")).startswith("sceneslam."):
        for name, hint in hints_of(_locate(node["_target_"])).items():
            yield f"{prefix}{name}", hint
    for name, inner in node.items():
        yield from _hints(inner, f"{prefix}{name}.")


def _head(path: Path) -> str:
    """Return the comment that a file begins with; what is set off in it is code."""
    lines: list[str] = []
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            break
        text = line.removeprefix("#").removeprefix(" ")
        if not text.startswith("@package"):
            lines.append(f"\n    {text.strip()}\n" if text.startswith("  ") else text)
    return "\n".join(lines)


def _based(entry: str | dict[str, str]) -> str:
    if isinstance(entry, str):
        return f"`{entry}`"
    ((group, choice),) = entry.items()
    return f"`{group.removeprefix('override ').lstrip('/')}={choice}`"


def _rows(path: Path, is_shown: Callable[[str], bool], hints: Mapping[str, object]) -> str:
    rows = [
        _row(
            f"`{key.name}`", f"`{key.value}`" if key.value else "", _type(hints, key.name), key.note
        )
        for key in keys_of(path)
        if is_shown(key.name) and (key.value or key.note)
    ]
    if not rows:
        return ""
    return "\n".join(["| key | default | takes | meaning |", "|---|---|---|---|", *rows])


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _type(hints: Mapping[str, object], name: str) -> str:
    return describe(hints[name]) if name in hints else ""


def _locate(target: str) -> object:
    module, _, name = target.rpartition(".")
    return getattr(import_module(module), name)


def _code(title: str, path: str) -> str:
    module = import_module(path)
    parts = [f"# {title}\n\n`{path}`\n\n{inspect.getdoc(module)}"]
    parts += [_class(kind) for kind in _classes(module)]
    return "\n\n".join(parts) + "\n"


def _classes(module: ModuleType) -> list[type]:
    own = [kind for _, kind in inspect.getmembers(module, inspect.isclass)]
    mine = [kind for kind in own if kind.__module__ == module.__name__]
    return sorted(mine, key=lambda kind: inspect.getsourcelines(kind)[1])


def _class(kind: type) -> str:
    """Return a class as it is written, which here says all: its fields, units and promises."""
    source = inspect.getsource(kind)
    return f"## {kind.__name__}\n\n```python\n{source.rstrip()}\n```"


if __name__ == "__main__":
    sys.stdout.write("\n\n".join(pages().values()))
