"""A run's folder: claimed by one run at a time, in which nothing foreign is touched."""

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
from sceneslam.types.errors import ConfigError, told
from sceneslam.types.files import MARK, owned

_HYDRAS = (".hydra", "multirun.yaml")  # what Hydra writes before a run begins, beside its log
# What every run writes: none of it may be there already, written by somebody else.
_NAMES = (
    *("config.yaml", "events.jsonl", "journal.bin", "metrics.json", "report.html"),
    *("trajectory.tum", "trajectory_online.tum", "trajectory_covariance.txt", "groundtruth.tum"),
    *("map/points.ply", "map/grid.pgm", "map/grid.yaml", "map/pose_graph.g2o"),
    *("map/pose_graph.tum", "map/landmarks.ply"),
)
_TRIES = 20  # where another run gives back the folder above this one at the same time


@dataclass(slots=True)
class RunFolder:
    """A folder that is this run's until `close`, or until the process ends, however it does."""

    path: Path
    _lock: int | None  # descriptor of the mark; None: this process claimed the folder before

    @classmethod
    def claim(cls, path: Path, *, is_stamped: bool = False, key: str = "folder") -> RunFolder:
        """Make a folder, or take one that is empty or that runs made.

        `is_stamped`: its name is an instant; where it is taken, this one gets a number (`_1`).
        Raises ConfigError for `key` where the folder holds what no run wrote, belongs to a run
        that is under way, or cannot be made.
        """
        made = _Made(path=path, folders=[])
        try:
            made = _make(path.absolute(), is_stamped)
            return cls(made.path, _take(made, key))
        except OSError as error:
            _unmake(made)
            allowed = f"a folder that can be written ({told(error)})"
            raise ConfigError(key, str(path), allowed) from error

    def clear(self) -> None:
        """Remove what an earlier run left, so that nothing old stands beside the new."""
        for name in owned(self.path):
            (self.path / name).unlink(missing_ok=True)
        _write_mark(self.path, _read_mark(self.path), [])

    def close(self) -> None:
        """Let another run have the folder. May be called twice."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def give_back(path: Path) -> None:
    """Remove a folder that this process claimed, with the folders made for it: nothing was run.

    It stays where it was there before, or holds more than a run's own files.
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
        with suppress(OSError):  # a folder goes below
            (path / name).unlink()
    (path / MARK).unlink()
    for name in (*tops, *_HYDRAS):
        with suppress(OSError):  # not there
            (path / name).rmdir()
    _unmake(_Made(path=path, folders=mark["made"]))


@dataclass(frozen=True, slots=True)
class _Made:
    path: Path
    folders: list[str]  # that were made for it, itself last


def _make(path: Path, is_stamped: bool) -> _Made:
    """Make a folder and those above it; where its name is an instant, one that was not there."""
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
        except FileNotFoundError:  # another run gave a folder above it back just now
            if attempt == _TRIES - 1:
                raise
    raise AssertionError


def _unmake(made: _Made) -> None:
    """Remove the folders that were made, where they are empty but for a mark without a line."""
    with suppress(OSError):
        if not (made.path / MARK).stat().st_size:
            (made.path / MARK).unlink()
    for folder in reversed(made.folders):
        with suppress(OSError):
            Path(folder).rmdir()


def _mkdir(folder: Path) -> bool:
    """Make a folder; return whether it was not there."""
    if folder.is_dir():
        return False
    try:
        folder.mkdir()
    except FileExistsError:
        return False
    return True


def _take(made: _Made, key: str) -> int | None:
    """Lock the mark of a folder, and write it; None where this process has it already."""
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
            os.close(mark)
            return None
        if not _is_there(mark, path / MARK):  # given back between opening and locking
            os.close(mark)
            return _take(made, key)
        is_new, names = os.fstat(mark).st_size == 0, owned(path)
        _refuse_foreign(path, {one for one in _NAMES if (path / one).exists()} - {*names}, key)
        about = {"sceneslam": sceneslam.__version__, **_who()}
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
    """Write the mark anew, in place: it stays locked."""
    with (path / MARK).open("r+") as file:
        file.write("".join(f"{line}\n" for line in [json.dumps(about), *names]))
        file.truncate()


def _refuse_foreign(path: Path, foreign: set[str], key: str) -> None:
    if foreign:
        more = f" and {len(foreign) - 1} more" if len(foreign) > 1 else ""
        holds = f"it holds what no run wrote: {min(foreign)}{more}"
        raise ConfigError(key, str(path), f"a new folder, or an empty one ({holds})")


def _is_locked(mark: int) -> bool:
    """Lock a file for as long as it is open; False where another has it."""
    try:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):  # a network's disk may know none
            raise
    return True


def _who() -> dict[str, Any]:
    return {"host": platform.node(), "pid": os.getpid()}


def _is_own(mark: dict[str, Any]) -> bool:
    return {key: mark.get(key) for key in ("host", "pid")} == _who()


def _read_mark(path: Path) -> dict[str, Any]:
    """Return what the mark of a folder says of its newest run; empty without a mark."""
    try:
        about = json.loads((path / MARK).read_text().partition("\n")[0])
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) else {}


def _is_hydras(name: str) -> bool:
    top = Path(name).parts[0]
    return top in _HYDRAS or (top == name and name.endswith(".log"))
