"""The end of a process, which no thread delays that a module or sink has left running."""

from __future__ import annotations

import logging
import os
import sys
import threading
from time import sleep

_log = logging.getLogger(__name__)
_PATIENCE_S = 3.0  # for threads to end by themselves


def leave_threads(code: int) -> None:
    """Let this process, which exits now with a code, end within some seconds.

    Python waits for every thread that is not a daemon, such as one that waits for input. Those that
    still run then are named in a warning, and end with the process.
    """
    threads = [one for one in threading.enumerate() if not one.daemon]
    is_ending = threading.Event()
    # Python calls the newest first of what is registered so, then waits for the threads of pools,
    # which is registered as well, then for the others, and only then calls `atexit` functions.
    threading._register_atexit(is_ending.set)  # type: ignore[attr-defined]
    args = (threads, code, is_ending)
    threading.Thread(target=_watch, args=args, name="exit", daemon=True).start()


def _watch(threads: list[threading.Thread], code: int, is_ending: threading.Event) -> None:
    is_ending.wait()  # a program that called ours may go on
    sleep(_PATIENCE_S)
    left = [one.name for one in threads if one.is_alive() and one is not threading.main_thread()]
    if not left:
        return
    _log.warning("ended with the process: thread %s", ", ".join(left))
    logging.shutdown()
    sys.stdout.flush()
    os._exit(code)
