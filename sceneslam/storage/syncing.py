"""Periodic syncing of growing files to disk, in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

_EVERY_S = 0.5  # largest loss by a power failure, plus the time of one sync


class Syncing:
    """Calls all `sync` functions periodically in a thread until it is closed."""

    def __init__(self, *syncs: Callable[[], None]) -> None:
        self._syncs = syncs
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="syncing", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop. May be called twice."""
        self._is_over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._is_over.wait(_EVERY_S):
            for sync in self._syncs:
                with suppress(OSError):  # disk errors are reported by writing
                    sync()
