"""Main function of a module's process: builds the module and serves requests."""

from __future__ import annotations

import fcntl
import logging
import os
import pickle
import resource
import signal
import socket
import traceback
from collections.abc import Callable
from typing import Any

from sceneslam.interfaces import closes_own_loops
from sceneslam.supervision.messages import LogLine, Reply, Request
from sceneslam.supervision.transport import Channel
from sceneslam.types.errors import ModuleError


class Worker:
    """Owns the module and serves requests."""

    def __init__(self) -> None:
        self._module: Any = None
        self._log = _Collector()
        logging.getLogger().addHandler(self._log)

    def answer(self, request: Request) -> Reply:
        """Return the result or exception of the requested method."""
        try:
            value = self._call(request)
        except BaseException as error:
            return Reply(
                number=request.number,
                error=_portable(error),
                traceback=traceback.format_exc(),
                log=self._log.take(),
            )
        return Reply(number=request.number, value=value, log=self._log.take())

    def build(self, make: Callable[[], Any], log_level: int, memory_limit_mb: int) -> Any:
        """Build the module; return its `requires`, and whether it closes loops."""
        logging.getLogger().setLevel(log_level)
        limit_bytes = memory_limit_mb << 20
        resource.setrlimit(resource.RLIMIT_DATA, (limit_bytes, limit_bytes))
        self._module = make()
        return self._module.requires, closes_own_loops(self._module)

    def _call(self, request: Request) -> Any:
        owner = self if request.method == "build" else self._module
        return getattr(owner, request.method)(*request.arguments)


def serve(channel: Channel) -> None:
    """Serve requests until the channel is closed."""
    worker = Worker()
    while True:
        try:
            reply = worker.answer(channel.receive())
        except EOFError:
            return
        try:
            channel.send(reply)
        except ConnectionError:
            return
        except Exception as error:
            channel.send(Reply(number=reply.number, error=ModuleError(f"its answer: {error}")))
        del reply  # it may refer to shared memory


class _Collector(logging.Handler):
    """Collects log records, which are sent with the next reply."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: list[LogLine] = []

    def emit(self, record: logging.LogRecord) -> None:
        line = LogLine(logger=record.name, level=record.levelno, text=self.format(record))
        self._lines.append(line)

    def take(self) -> tuple[LogLine, ...]:
        lines, self._lines = tuple(self._lines), []
        return lines


def _portable(error: BaseException) -> Exception:
    """Return the error if it can be pickled, else a ModuleError with its message."""
    try:
        if isinstance(error, Exception) and type(pickle.loads(pickle.dumps(error))) is type(error):
            return error
    except Exception:
        pass  # cannot be unpickled: its constructor needs other arguments
    return ModuleError(f"{type(error).__name__}: {error}")


def _die_with_parent(lifeline: int) -> None:
    """Let the kernel end this process when the other end of `lifeline` is closed.

    The closed pipe raises SIGIO, which terminates by default: it needs no thread and no GIL, and
    does not depend on which thread of the parent started this process (as PR_SET_PDEATHSIG does).
    """
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    flags = fcntl.fcntl(lifeline, fcntl.F_GETFL)
    fcntl.fcntl(lifeline, fcntl.F_SETFL, flags | os.O_ASYNC)


def main(line: int, lifeline: int) -> None:
    """Serve on the inherited descriptors.

    Requests to stop, which may reach all processes of a service, are the parent's to handle: it
    still asks for poses and maps.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    _die_with_parent(lifeline)
    serve(Channel(socket.socket(fileno=line)))
