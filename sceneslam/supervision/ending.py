"""Exit codes of processes as text, and killing of a process with all its children."""

from __future__ import annotations

import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

MARK = "SCENESLAM_PROCESS"  # in the environment of all processes that a module starts


def how_it_ended(code: int) -> str:
    """Return an exit code as text that follows `it`."""
    if code < 0:
        names = {one.value: one.name for one in signal.Signals}  # without the real-time signals
        return f"was killed by signal {-code} ({names.get(-code, 'real-time')})"
    return f"ended by itself with exit code {code}"


def kill_all(popen: subprocess.Popen[bytes], mark: str) -> None:
    """Kill a process, its group and all processes with its mark; leave no zombie."""
    with suppress(ProcessLookupError):
        os.killpg(popen.pid, signal.SIGKILL)
    popen.wait()
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if f"{MARK}={mark}".encode() in path.read_bytes():
                os.kill(int(path.parent.name), signal.SIGKILL)
