"""A module's process on the parent's side: start, requests with deadlines, and end."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from contextlib import suppress
from time import monotonic
from typing import Any
from uuid import uuid4
from weakref import finalize

from sceneslam.supervision.ending import MARK, how_it_ended, kill_all
from sceneslam.supervision.limits import Limits
from sceneslam.supervision.messages import Reply, Request
from sceneslam.supervision.transport import Channel
from sceneslam.types.errors import ModuleError, text_of

_END_PATIENCE_S = 1.0  # for a process to end after its channel was closed
# The path is set after start-up: files in the user's folder must not shadow standard modules.
_MAIN = """
import sys
line, lifeline, *sys.path = sys.argv[1:]
from sceneslam.supervision.worker import main
main(int(line), int(lifeline))
"""


class ProcessDeathError(ModuleError):
    """The process has ended; the message says how."""


class Process:
    """Sends requests to one process and receives its replies, in order.

    Any failure of the process itself (ended, too slow, out of memory) ends it and raises
    ProcessDeathError. It ends with this object and with the parent, however the parent ends.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        lifeline, self._lifeline = os.pipe()
        mark = uuid4().hex
        self._popen = subprocess.Popen(
            [sys.executable, "-P", "-c", _MAIN, str(far.fileno()), str(lifeline), *sys.path],
            # Other thread settings are the parent's: BLAS sums depend on the number of threads.
            env={**os.environ, "OPENCV_FOR_THREADS_NUM": str(limits.threads), MARK: mark},
            stdin=subprocess.DEVNULL,
            pass_fds=(far.fileno(), lifeline),
            process_group=0,  # Ctrl-C is handled by the parent
        )
        far.close()
        os.close(lifeline)
        self._channel = Channel(near, os.pidfd_open(self._popen.pid))
        self._number = 0
        self._asked_s = 0.0
        self._end = finalize(self, _end, self._popen, self._channel, self._lifeline, mark)

    @property
    def is_alive(self) -> bool:
        """Tell whether the process runs."""
        return self._end.alive and self._popen.poll() is None

    def submit(self, method: str, *arguments: object) -> None:
        """Send a request; `collect` returns its reply."""
        self._number += 1
        self._asked_s = monotonic()
        request = Request(number=self._number, method=method, arguments=arguments)
        try:
            self._channel.send(request)
        except OSError as error:
            raise self._died() from error

    def has_answer(self) -> bool:
        """Tell whether `collect` would return or raise without waiting."""
        return self._channel.has_message()

    def collect(self, deadline_s: float) -> Any:
        """Return the last request's result, or raise its exception.

        The deadline starts at the request. Replies to earlier requests that were not collected
        because of an interrupt are skipped.
        """
        while True:
            left_s = max(self._asked_s + deadline_s - monotonic(), 1e-3)
            try:
                reply: Reply = self._channel.receive(left_s)
            except TimeoutError as error:
                self._end()
                raise ProcessDeathError(f"did not answer within {deadline_s:g} s") from error
            except EOFError as error:
                raise self._died() from error
            except Exception as error:
                self._end()
                raise ProcessDeathError(f"sent an invalid reply ({text_of(error)})") from error
            for line in reply.log:
                logging.getLogger(line.logger).log(line.level, "%s", line.text)
            if reply.number == self._number:
                return self._opened(reply)

    def end(self) -> None:
        """End the process; may be called twice."""
        if self._end.alive:
            self._channel.close()  # the process ends when its channel is closed
            with suppress(subprocess.TimeoutExpired):
                self._popen.wait(_END_PATIENCE_S)
        self._end()

    def _opened(self, reply: Reply) -> Any:
        if isinstance(reply.error, MemoryError):
            self._end()
            raise ProcessDeathError(
                f"used more than {self._limits.memory_limit_mb} MB"
            ) from reply.error
        if reply.error is not None:
            raise reply.error from _Elsewhere(reply.traceback)
        return reply.value

    def _died(self) -> ProcessDeathError:
        """Return the error with the exit code of the process that closed its channel."""
        with suppress(subprocess.TimeoutExpired):
            self._popen.wait(_END_PATIENCE_S)
        self._end()
        return ProcessDeathError(how_it_ended(self._popen.returncode))


class _Elsewhere(Exception):  # noqa: N818 - not an error, but where one came from
    """The traceback of an exception in a module's process."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def _end(popen: subprocess.Popen[bytes], channel: Channel, lifeline: int, mark: str) -> None:
    """Kill a process with all its children, and close the connections to it."""
    kill_all(popen, mark)
    channel.close()
    os.close(lifeline)
