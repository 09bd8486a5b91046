"""How a run's files come to be: whole or not at all, and never in the place of a foreign file."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from sceneslam.types.errors import text_of
from sceneslam.types.input_files import given_path

MARK = ".sceneslam"  # in a folder that runs write into: one line about the run, then their files
PART = ".part"  # at the end of a file's name until it is whole
_LEVELS = 2  # a run's files lie in its folder, or in a folder in it


@contextmanager
def replacing(path: Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a file that gets its name once it is written and on disk; an exception leaves nothing.

    `mode` and `options` are those of `open`. Raises FileExistsError as `own` does.
    """
    own(path)
    own(path.with_name(path.name + PART))
    with whole(path, mode, **options) as file:
        yield file


@contextmanager
def whole(path: Path, mode: str = "w", **options: Any) -> Iterator[IO[Any]]:
    """Open a file as `replacing` does, but one that outlasts the run, and is not listed."""
    part = path.with_name(path.name + PART)
    try:
        with part.open(mode, **options) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def new_file(folder: Path, path: str) -> Path:
    """Return the path of a file that a run will write, in its folder unless absolute; make that.

    Raises FileExistsError where there is such a file, as the recording that is read, or its part,
    and InputError for an empty path.
    """
    file = (folder / given_path(path)).resolve()
    for known in (file, file.with_name(file.name + PART)):
        if os.path.lexists(known):
            raise FileExistsError(errno.EEXIST, "this file is not replaced", str(known))
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def part_of(path: Path) -> Path:
    """Return the name that a file has until it is whole, listed as that of a run."""
    return own(path.with_name(path.name + PART))


def finish(path: Path) -> None:
    """Give a file that was written as `part_of(path)`, and is whole now, its name."""
    own(path)
    part = part_of(path)
    with part.open("rb") as file:
        os.fsync(file.fileno())
    part.replace(path)


def own(path: Path) -> Path:
    """List a file, before it is written, in the mark of the run's folder; return its path.

    Raises FileExistsError where there is a file of that name that no run wrote. In a folder
    without a mark nothing is listed.
    """
    for folder in path.parents[:_LEVELS]:
        if (folder / MARK).is_file():
            name = path.relative_to(folder).as_posix()
            if name in owned(folder):
                return path
            if os.path.lexists(path):
                raise FileExistsError(errno.EEXIST, "there is a file that no run wrote", str(path))
            with (folder / MARK).open("a") as mark:
                mark.write(f"{name}\n")
            break
    return path


def owned(folder: Path) -> list[str]:
    """Return the names, relative to the folder, of the files in it that runs wrote."""
    names = (folder / MARK).read_text(errors="replace").splitlines()[1:]
    return [name for name in names if not name.startswith("/") and ".." not in Path(name).parts]


class AppendedFile:
    """A file that grows by whole pieces: after a failure it ends with the last whole one."""

    def __init__(self, path: Path, make_room: Callable[[], bool] = lambda: False) -> None:
        """Begin the file; `make_room` gives room on a full disk, and returns whether it did."""
        self._fd = os.open(own(path), os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._size, self._make_room = 0, make_room

    def append(self, piece: bytes) -> None:
        """Hand a piece to the system, which keeps it if this process dies; raises OSError."""
        left = memoryview(piece)
        try:
            while left:
                left = left[self._write(left) :]
        except OSError:
            os.ftruncate(self._fd, self._size)
            os.lseek(self._fd, self._size, os.SEEK_SET)
            raise
        self._size += len(piece)

    def sync(self) -> None:
        """Wait until what was appended outlives a loss of power."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    def _write(self, data: memoryview) -> int:
        while True:
            try:
                return os.write(self._fd, data)
            except OSError as error:
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not self._make_room():
                    raise


class LogFile:
    """An appended file that a run can do without: `fault` says why it ends before the run does."""

    def __init__(self, path: Path, make_room: Callable[[], bool] = lambda: False) -> None:
        """Begin the file; `make_room` as for `AppendedFile`."""
        self.fault = ""
        self._name = path.name
        self._file: AppendedFile | None = AppendedFile(path, make_room)

    @property
    def is_open(self) -> bool:
        """Tell whether it still takes pieces."""
        return self._file is not None

    def append(self, piece: bytes) -> None:
        """Hand a piece to the system, which keeps it if this process dies; a failure closes it."""
        if self._file is None:
            return
        try:
            self._file.append(piece)
        except OSError as error:
            self.fault = f"{self._name} is not complete: {text_of(error)}"
            self.close()

    def sync(self) -> None:
        """Wait until what was appended outlives a loss of power; may be called by a thread."""
        file = self._file
        if file is not None:
            file.sync()

    def close(self) -> None:
        """Close the file. May be called twice."""
        file, self._file = self._file, None
        if file is not None:
            file.close()
