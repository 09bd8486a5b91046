"""One line with the state of all jobs of a sweep."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from sceneslam.collect.status import State, Status

_LOOK_S = 0.5
_TOLD = (State.RUNNING, State.INCOMPLETE, State.FAILED, State.KILLED, State.STOPPED)


class Progress:
    """A context manager that shows the states of the jobs, read from their folders."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._waiting = set(folders)
        self._states: Counter[State] = Counter()
        self._told = ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True, name="progress")

    def __enter__(self) -> Progress:
        self._bar = tqdm(total=len(self._waiting), desc="sweep", unit="job", smoothing=0.0)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()
        self._show()
        self._bar.close()

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_S):
            self._show()

    def _show(self) -> None:
        found = {folder: Status.read(folder) for folder in self._waiting}
        states = {folder: status.state for folder, status in found.items() if status}
        settled = {folder for folder, status in found.items() if status and status.is_settled}
        self._states.update(states[folder] for folder in settled)
        self._waiting -= settled
        counts = self._states + Counter(
            states[folder] for folder in states if folder not in settled
        )
        counted = [f"{counts[state]} {state.value}" for state in _TOLD if counts[state]]
        before, self._told = self._told, ", ".join(counted)
        self._bar.set_postfix_str(self._told, refresh=False)
        self._bar.n += len(settled)
        if settled or self._told != before or sys.stderr.isatty():
            self._bar.refresh()
