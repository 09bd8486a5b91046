"""The folder of a run, sweep, ...: locked while it is written; files of others stay."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import sceneslam
from sceneslam.types.errors import ConfigError, text_of
from sceneslam.types.files import MARK, owned

_HYDRAS = (".hydra", "multirun.yaml")  # written by Hydra before a run begins, beside its log
# The files of every run: none of them may exist already if no run wrote it.
_NAMES = (
    *("config.yaml", "events.jsonl", "journal.bin", "metrics.json", "report.html"),
    *("trajectory.tum", "trajectory_online.tum", "trajectory_covariance.txt", "groundtruth.tum"),
    *("map/points.ply", "map/grid.pgm", "map/grid.yaml", "map/pose_graph.g2o"),
    *("map/pose_graph.tum", "map/landmarks.ply"),
)
_TRIES = 20  # in case another run removes a parent folder at the same time


@dataclass(slots=True)
class RunFolder:
    """A folder that is locked for this run until `close` or the end of the process."""

    path: Path
    _lock: int | None  # descriptor of the lock file; None: this process has the lock already

    @classmethod
    def claim(
        cls, path: Path, *, kind: str = "run", is_stamped: bool = False, key: str = "folder"
    ) -> RunFolder:
        """Create a folder, or use one that is empty or belongs to the same `kind` of results.

        `is_stamped`: its name is a time; if it exists, a number is added (`_1`). Raises ConfigError
        for `key` if the folder holds other files, is in use by a run, or cannot be created.
        """
        made = _Made(path=path, folders=[])
        try:
            made = _make(path.absolute(), is_stamped)
            return cls(made.path, _take(made, kind, key))
        except OSError as error:
            _unmake(made)
            allowed = f"a folder that can be written ({text_of(error)})"
            raise ConfigError(key, str(path), allowed) from error

    def clear(self) -> None:
        """Remove the files of an earlier run."""
        for name in owned(self.path):
            (self.path / name).unlink(missing_ok=True)
        _write_mark(self.path, _read_mark(self.path), [])

    def close(self) -> None:
        """Unlock the folder. May be called twice."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def give_back(path: Path) -> None:
    """Remove a folder that this process created without a run, with its created parents.

    It is kept if it existed before, or holds other files.
    """
    mark = _read_mark(path)
    if not mark.get("is_new") or not _is_own(mark):
        return
    names = owned(path)
    tops = {Path(name).parts[0] for name in names}
    if not all(_is_hydras(one.name) or one.name in {*tops, MARK} for one in path.iterdir()):
        return
    hydras = [str(one.relative_to(path)) for one in path.glob("*") if _is_hydras(one.name)]
    hydras += [str(one.relative_to(path)) for one in path.glob(".hydra/*")]
    for name in [*names, *hydras]:
        with suppress(OSError):  # a folder is removed below
            (path / name).unlink()
    (path / MARK).unlink()
    for name in (*tops, *_HYDRAS):
        with suppress(OSError):  # does not exist
            (path / name).rmdir()
    _unmake(_Made(path=path, folders=mark["made"]))


@dataclass(frozen=True, slots=True)
class _Made:
    path: Path
    folders: list[str]  # created folders, itself last


def _make(path: Path, is_stamped: bool) -> _Made:
    """Create a folder and its parents; with a time as name, a new one."""
    above: list[str] = []
    for attempt in range(_TRIES):
        try:
            above += [str(one) for one in reversed(path.parents) if _mkdir(one)]
            numbered = (path.with_name(f"{path.name}_{number}") for number in count(1))
            one, is_new = path, _mkdir(path)
            while is_stamped and not is_new:
                one = next(numbered)
                is_new = _mkdir(one)
            return _Made(path=one, folders=[*above, *([str(one)] if is_new else [])])
        except FileNotFoundError:  # another run has just removed a parent folder
            if attempt == _TRIES - 1:
                raise
    raise AssertionError


def _unmake(made: _Made) -> None:
    """Remove the created folders if they are empty except for an empty lock file."""
    with suppress(OSError):
        if not (made.path / MARK).stat().st_size:
            (made.path / MARK).unlink()
    for folder in reversed(made.folders):
        with suppress(OSError):
            Path(folder).rmdir()


def _mkdir(folder: Path) -> bool:
    """Create a folder; return whether it is new."""
    if folder.is_dir():
        return False
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _take(made: _Made, kind: str, key: str) -> int | None:
    """Lock and write the lock file of a folder; None if this process has the lock already."""
    path = made.path
    if not (path / MARK).exists():
        _refuse_foreign(path, {one.name for one in path.iterdir()} - {MARK}, key)
    mark = os.open(path / MARK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if not _is_locked(mark):
            other = _read_mark(path)
            if not _is_own(other):
                by = f"process {other.get('pid')} on {other.get('host')} is"
                raise ConfigError(key, str(path), f"a folder that no run is writing; {by}")
            _refuse_kind(path, kind, key)
            os.close(mark)
            return None
        if not _is_there(mark, path / MARK):  # removed between opening and locking
            os.close(mark)
            return _take(made, kind, key)
        _refuse_kind(path, kind, key)
        is_new, names = os.fstat(mark).st_size == 0, owned(path)
        _refuse_foreign(path, {one for one in _NAMES if (path / one).exists()} - {*names}, key)
        about = {"sceneslam": sceneslam.__version__, "kind": kind, **_who()}
        _write_mark(path, about | {"is_new": is_new, "made": made.folders}, names)
    except (OSError, ConfigError):
        os.close(mark)
        raise
    return mark


def _is_there(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _write_mark(path: Path, about: dict[str, Any], names: list[str]) -> None:
    """Rewrite the lock file in place, so that it stays locked."""
    with (path / MARK).open("r+") as file:
        file.write("".join(f"{line}\n" for line in [json.dumps(about), *names]))
        file.truncate()


def _refuse_foreign(path: Path, foreign: set[str], key: str) -> None:
    if foreign:
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        holds = f"it holds files that no run wrote: {min(foreign)}{more}"
        raise ConfigError(key, str(path), f"a new folder, or an empty one ({holds})")


def _refuse_kind(path: Path, kind: str, key: str) -> None:
    """Refuse a folder of another kind; older versions wrote none."""
    other = _read_mark(path).get("kind", kind)
    if other != kind:
        allowed = f"a new folder, or that of a {kind} (it is the folder of a {other})"
        raise ConfigError(key, str(path), allowed)


def _is_locked(mark: int) -> bool:
    """Lock a file while it is open; False if another process has the lock."""
    try:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (
            errno.ENOLCK,
            errno.EOPNOTSUPP,
        ):  # not supported
            raise
    return True


def _who() -> dict[str, Any]:
    return {"host": platform.node(), "pid": os.getpid()}


def _is_own(mark: dict[str, Any]) -> bool:
    return {key: mark.get(key) for key in ("host", "pid")} == _who()


def _read_mark(path: Path) -> dict[str, Any]:
    """Return the contents of a folder's lock file; empty without one."""
    try:
        about = json.loads((path / MARK).read_text().partition("\n")[0])
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}


def _is_hydras(name: str) -> bool:
    top = Path(name).parts[0]
    return top in _HYDRAS or (top == name and name.endswith(".log"))
