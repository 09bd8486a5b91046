"""Standard streams that never fail: closed, without a reader, or on a full disk."""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import TextIO

# Native code too: no other file may get the descriptors of the standard streams.
_DESCRIPTORS = (0, 1, 2)


def secure_streams() -> None:
    """Open closed standard streams, and let writing to them never fail.

    If the reader has ended or the disk is full, output is lost without an error. Must be called
    before any import that may open a file or write.
    """
    logging.raiseExceptions = False  # do not report log messages that cannot be written
    for number in _DESCRIPTORS:
        if not _is_open(number):
            _put_nothing(number)
    if sys.stdout is sys.__stdout__:  # else it was replaced, and is not ours
        sys.stdout = _stream(1, sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _stream(2, sys.stderr)


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def _put_nothing(number: int) -> None:
    """Redirect a descriptor to the null device, for this process and its children."""
    null = os.open(os.devnull, os.O_RDWR)
    if null == number:
        os.set_inheritable(null, True)
    else:
        os.dup2(null, number)
        os.close(null)


def _stream(number: int, before: TextIO | None) -> TextIO:
    """Return a text stream as the interpreter makes it, over a file that never fails."""
    if before is not None:
        before.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(_Forgiving(number, "w", closefd=False)),
        encoding=before.encoding if before is not None else "utf-8",
        errors="backslashreplace",
        line_buffering=number == 2 or os.isatty(number),
    )


def lost_output() -> OSError | None:
    """Return the error of standard output, None without one or if its reader has ended."""
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    error = raw.error if isinstance(raw, _Forgiving) else None
    return None if isinstance(error, BrokenPipeError) else error


class _Forgiving(io.FileIO):
    """A file that ignores writes after the first failure."""

    error: OSError | None = None

    def write(self, data: object) -> int:
        try:
            written = super().write(data)  # type: ignore[arg-type]
        except OSError as error:
            written, self.error = None, error
            _put_nothing(self.fileno())  # also for native code and child processes
        return memoryview(data).nbytes if written is None else written  # type: ignore[arg-type]
