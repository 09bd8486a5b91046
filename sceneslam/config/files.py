"""Reading of users' YAML files, with limits on their names and size."""

from __future__ import annotations

import filecmp
from importlib import resources
from pathlib import Path

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult

from sceneslam.types.errors import ConfigError, InputError

_MOST_BYTES = 1 << 20
_MOST_VALUES = 20_000  # with expanded aliases; our largest file has a hundred
_DEEPEST = 32


class CheckedFiles(FileConfigSource):
    """Hydra's reader of `--config-dir` and `hydra.searchpath`, with limits on names and size."""

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        if provider != "main":  # `--config-path` replaces ours
            check_names(Path(self.path))

    def load_config(self, config_path: str) -> ConfigResult:
        """Return a file's contents; raises InputError if it is too large."""
        path = Path(self.path) / self._normalize_file_name(config_path)
        if path.is_file():
            check_yaml(path)
        return super().load_config(config_path)


def register() -> None:
    """Register this class as Hydra's file reader."""
    Plugins.instance()  # registers Hydra's own reader first
    SourcesRegistry.instance().types[CheckedFiles.scheme()] = CheckedFiles


def check_names(folder: Path) -> None:
    """Raise ConfigError for an option in a folder that differs from ours of the same name.

    Hydra reads the first file of a name that it finds, which is ours.
    """
    conf = Path(str(resources.files("sceneslam.conf")))
    for ours in sorted(conf.glob("*/**/*.yaml")):
        theirs = Path(folder, ours.relative_to(conf))
        if theirs.is_file() and not filecmp.cmp(ours, theirs, shallow=False):
            group, _, name = ours.relative_to(conf).with_suffix("").as_posix().partition("/")
            base = f"`defaults: [/{group}/{name}@_here_]` bases yours on it"
            allowed = f"another name, as ours is read for {name} ({base})"
            raise ConfigError(group, str(theirs), allowed)


def check_yaml(path: Path) -> None:
    """Raise InputError for a file that is too large, also after expansion of its aliases."""
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise InputError(f"a YAML file has {size} bytes, at most {_MOST_BYTES} are read: {path}")
    with path.open("rb") as file:
        try:
            _count_values(file.read(), path)
        except yaml.YAMLError:
            return  # the reader reports the position
        except UnicodeDecodeError:
            return


def _count_values(text: bytes, path: Path) -> None:
    """Raise InputError if a file has too many values, with expanded aliases."""
    sizes: dict[str, int] = {}  # of anchored values
    opened: list[tuple[str | None, int]] = []  # anchor, values before it
    count = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            count += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, count))
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = opened.pop()
            if anchor:
                sizes[anchor] = count - before
        if count > _MOST_VALUES:
            raise InputError(f"a YAML file holds more than {_MOST_VALUES} values: {path}")
        if len(opened) > _DEEPEST:
            raise InputError(f"a YAML file is nested deeper than {_DEEPEST} levels: {path}")
