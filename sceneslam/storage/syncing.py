"""Syncs files to disk while they grow, in a thread beside their writer."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

_EVERY_S = 0.5  # what a loss of power costs at most, beside the wait itself


class Syncing:
    """Calls every `sync` again and again, in a thread of its own, until it is closed."""

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
                with suppress(OSError):  # what the disk does not take shows when it is written
                    sync()
