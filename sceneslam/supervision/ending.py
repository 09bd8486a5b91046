"""How a process ended, and how one is ended together with all that it started."""

from __future__ import annotations

import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

MARK = "SCENESLAM_PROCESS"  # in the environment of all that a module starts


def how_it_ended(code: int) -> str:
    """Return what an exit code says, after `it`."""
    if code < 0:
        names = {one.value: one.name for one in signal.Signals}  # without the real-time signals
        return f"was killed by signal {-code} ({names.get(-code, 'real-time')})"
    return f"ended by itself with exit code {code}"


def kill_all(popen: subprocess.Popen[bytes], mark: str) -> None:
    """Kill a process, its group, and what left the group but bears its mark; leave no zombie."""
    with suppress(ProcessLookupError):
        os.killpg(popen.pid, signal.SIGKILL)
    popen.wait()
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if f"{MARK}={mark}".encode() in path.read_bytes():
                os.kill(int(path.parent.name), signal.SIGKILL)
