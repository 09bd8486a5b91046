"""A program with two pipes: start, requests with deadlines, and end with all its children."""

from __future__ import annotations

import fcntl
import logging
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from time import monotonic
from typing import Any, NoReturn
from uuid import uuid4
from weakref import finalize

from numpy.typing import NDArray

from sceneslam.supervision.ending import MARK, how_it_ended, kill_all
from sceneslam.supervision.limits import Limits
from sceneslam.types.errors import ModuleError

from .protocol import (
    HEAD_BYTES,
    Fields,
    MessageHeader,
    ProtocolError,
    as_text,
    pack,
    read_fields,
    read_head,
)

_log = logging.getLogger(__name__)
_CHUNK_BYTES = 1 << 20
_PIPE_BYTES = 1 << 20  # pipe buffer: the largest for unprivileged users
_LAST_WORDS_CHARS = 300
_LINES_MAX = 1000  # stored lines of a program's log
_PATIENCE_S = 1.0  # for a program to end after its input was closed
# The program's memory is limited, and the kernel ends it when the other end of the lifeline closes,
# as for the processes of modules (`supervision/worker.py`). Requests to stop are the parent's to
# handle, which still asks for the map. All of these settings survive exec.
_LAUNCH = """
import fcntl, os, resource, signal, sys
lifeline, limit = map(int, sys.argv[1:3])
fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
os.execvp(sys.argv[3], sys.argv[3:])
"""


class Program:
    """One run of a command; any failure ends it and raises ModuleError with one sentence."""

    def __init__(self, command: Sequence[str], limits: Limits) -> None:
        """Start the program, without waiting."""
        self._limits = limits
        self._inbox = bytearray()
        self._number = 0
        self._asked_s = monotonic()
        self._log = _Log(command[0])
        lifeline, kept = os.pipe()
        mark = uuid4().hex
        arguments = [str(lifeline), str(limits.memory_limit_mb << 20), *command]
        self._popen = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _LAUNCH, *arguments],
            env={**os.environ, "OPENCV_FOR_THREADS_NUM": str(limits.threads), MARK: mark},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            pass_fds=(lifeline,),
            process_group=0,  # Ctrl-C is handled by the parent
        )
        os.close(lifeline)
        pipes = (self._popen.stdin, self._popen.stdout, self._popen.stderr)
        self._stdin, self._stdout, self._stderr = [pipe.fileno() for pipe in pipes if pipe]
        for pipe in (self._stdin, self._stdout, self._stderr):
            os.set_blocking(pipe, False)
            _widen(pipe)
        self._end = finalize(self, _end, self._popen, kept, mark)

    @property
    def is_alive(self) -> bool:
        """Tell whether the program is running."""
        return self._end.alive and self._popen.poll() is None

    def has_answer(self) -> bool:
        """Tell whether there is output to read, or the program has ended."""
        return bool(self._inbox) or _await([self._stdout], [], 0.0)

    def send(self, kind: str, fields: Fields, deadline_s: float) -> None:
        """Write a request; `receive` returns its reply."""
        self._asked_s = monotonic()
        self._read()
        if self._inbox:
            self._fail(f"wrote {len(self._inbox)} bytes that were not asked for")
        self._number += 1
        for part in pack(kind, self._number, fields):
            self._write(part, deadline_s)

    def receive(self, kind: str, deadline_s: float) -> dict[str, NDArray[Any]]:
        """Return the fields of the reply; the deadline starts at `send`."""
        try:
            head = self._head(deadline_s)
            self._fill(HEAD_BYTES + head.length, deadline_s)
            fields = read_fields(head, self._inbox[HEAD_BYTES : HEAD_BYTES + head.length])
        except ProtocolError as error:
            self._fail(str(error))
        del self._inbox[: HEAD_BYTES + head.length]
        if head.kind == "error":
            self._fail(f"gave up: {as_text(fields['text']) if 'text' in fields else 'no reason'}")
        if (head.kind, head.number) != (kind, self._number):
            asked = f"{kind!r} number {self._number}"
            self._fail(f"answered {head.kind!r} number {head.number} to {asked}")
        return fields

    def refuse(self, reason: str) -> ModuleError:
        """End the program because of an invalid reply; return the error to raise."""
        self._end()
        return ModuleError(f"the program {reason}")

    def end(self) -> None:
        """Close the program's input, wait shortly, then kill it."""
        if self._end.alive:
            with suppress(OSError):
                assert self._popen.stdin is not None
                self._popen.stdin.close()
            with suppress(subprocess.TimeoutExpired):
                self._popen.wait(_PATIENCE_S)
        self._end()

    def _head(self, deadline_s: float) -> MessageHeader:
        self._fill(HEAD_BYTES, deadline_s)
        head = read_head(bytes(self._inbox[:HEAD_BYTES]))
        if head.length > self._limits.memory_limit_mb << 20:
            raise ProtocolError(
                f"announced {head.length} bytes, more than its {self._limits.memory_limit_mb} MB"
            )
        return head

    def _fill(self, count: int, deadline_s: float) -> None:
        """Read until `count` bytes are in the buffer; available bytes are never too late."""
        if len(self._inbox) < count:
            self._read()
        while len(self._inbox) < count:
            self._wait([self._stdout, self._stderr], [], deadline_s)
            self._read()

    def _write(self, part: memoryview, deadline_s: float) -> None:
        while part:
            try:
                part = part[os.write(self._stdin, part) :]
            except BlockingIOError:
                self._wait([self._stderr], [self._stdin], deadline_s)
                self._log.take(_read(self._stderr))
            except BrokenPipeError:
                self._fail_ended()

    def _read(self) -> None:
        """Read available output; raises ModuleError if the output was closed."""
        self._log.take(_read(self._stderr))
        data = _read(self._stdout)
        if data == b"":
            self._fail_ended()
        self._inbox += data or b""

    def _wait(self, readable: list[int], writable: list[int], deadline_s: float) -> None:
        left_s = self._asked_s + deadline_s - monotonic()
        if self._log.is_closed:
            readable = [pipe for pipe in readable if pipe != self._stderr]
        if left_s <= 0 or not _await(readable, writable, left_s):
            self._fail(f"did not answer within {deadline_s:g} s")

    def _fail_ended(self) -> NoReturn:
        with suppress(subprocess.TimeoutExpired):
            self._popen.wait(_PATIENCE_S)
        code = self._popen.poll()
        self._log.take(_read(self._stderr))
        self._fail("closed its output" if code is None else how_it_ended(code))

    def _fail(self, reason: str) -> NoReturn:
        raise self.refuse(reason + self._log.last_words)


class _Log:
    """A program's standard error: passed to the log, and kept for error messages."""

    def __init__(self, name: str) -> None:
        self._name, self._tail, self._lines = name, b"", 0
        self.is_closed = False

    def take(self, data: bytes | None) -> None:
        """Add bytes; b"" at the end, None if there are none."""
        self.is_closed = self.is_closed or data == b""
        if not data:
            return
        *lines, rest = (self._tail.rpartition(b"\n")[2] + data).split(b"\n")
        for line in lines[: max(_LINES_MAX - self._lines, 0)]:
            _log.info("%s: %s", self._name, line.decode("utf-8", "replace"))
        self._lines += len(lines)
        self._tail = b"\n".join([*lines[-3:], rest])[-4 * _LAST_WORDS_CHARS :]

    @property
    def last_words(self) -> str:
        """Return the last line, as the end of an error message."""
        lines = self._tail.decode("utf-8", "replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"; it wrote last: {last[-_LAST_WORDS_CHARS:]}" if last else ""


def _read(pipe: int) -> bytes | None:
    """Return the available bytes, None if there are none, b"" if the other end is closed."""
    try:
        return os.read(pipe, _CHUNK_BYTES)
    except BlockingIOError:
        return None


def _await(readable: Sequence[int], writable: Sequence[int], timeout_s: float) -> bool:
    """Wait until a pipe is ready or closed; return whether one is."""
    arrivals = select.poll()
    for pipe in readable:
        arrivals.register(pipe, select.POLLIN)
    for pipe in writable:
        arrivals.register(pipe, select.POLLOUT)
    return bool(arrivals.poll(1e3 * timeout_s))


def _widen(pipe: int) -> None:
    with suppress(AttributeError, OSError):  # Linux only, within the user's limit
        fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def _end(popen: subprocess.Popen[bytes], lifeline: int, mark: str) -> None:
    """Kill a program with all its children, and close its pipes."""
    kill_all(popen, mark)
    for pipe in (popen.stdin, popen.stdout, popen.stderr):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    os.close(lifeline)
