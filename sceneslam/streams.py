"""Standard output and error that nothing can break: closed, hung up on, or on a full disk."""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import TextIO

# In C, and in what an import may bring: nothing else may get the numbers of the standard streams.
_DESCRIPTORS = (0, 1, 2)


def secure_streams() -> None:
    """Open what is closed of standard input, output and error, and let writing never fail.

    Who reads them has gone, or their disk is full: then what is written is lost, and no more.
    Call it before anything is imported that may open a file or write.
    """
    logging.raiseExceptions = False  # a log that a full disk does not take is no news
    for number in _DESCRIPTORS:
        if not _is_open(number):
            _put_nothing(number)
    if sys.stdout is sys.__stdout__:  # else somebody else's
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
    """Let a descriptor be that of the null device, for this process and those it starts."""
    null = os.open(os.devnull, os.O_RDWR)
    if null == number:
        os.set_inheritable(null, True)
    else:
        os.dup2(null, number)
        os.close(null)


def _stream(number: int, before: TextIO | None) -> TextIO:
    """Return a text stream as the interpreter makes it, over a file that takes everything."""
    if before is not None:
        before.flush()
    return io.TextIOWrapper(
        io.BufferedWriter(_Forgiving(number, "w", closefd=False)),
        encoding=before.encoding if before is not None else "utf-8",
        errors="backslashreplace",
        line_buffering=number == 2 or os.isatty(number),
    )


def lost_output() -> OSError | None:
    """Return why standard output did not take what was written; None too where its reader left."""
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    error = raw.error if isinstance(raw, _Forgiving) else None
    return None if isinstance(error, BrokenPipeError) else error


class _Forgiving(io.FileIO):
    """Writes until that fails, and from then on into nothing."""

    error: OSError | None = None

    def write(self, data: object) -> int:
        try:
            written = super().write(data)  # type: ignore[arg-type]
        except OSError as error:
            written, self.error = None, error
            _put_nothing(self.fileno())  # for native code too, and processes started later
        return memoryview(data).nbytes if written is None else written  # type: ignore[arg-type]
