"""A source that is made at its first observation, by one process while others wait for it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sceneslam.interfaces import Source
from sceneslam.sources.cache_folder import writable
from sceneslam.sources.wrapped import Wrapped
from sceneslam.types.input_files import given_path
from sceneslam.types.observation import Observation
from sceneslam.types.truth import GroundTruth

_log = logging.getLogger(__name__)


class MadeOnce(Wrapped):
    """Holds a lock in the folder of made files until the first observation is there.

    Two processes make the same file, or two others, one after the other: making uses all cores.
    """

    def __init__(self, source: Source, folder: Path) -> None:
        super().__init__(source)
        self._folder = given_path(str(folder))

    def __iter__(self) -> Iterator[Observation]:
        """Yield the source's observations."""
        observations = iter(self._source)
        with self._locked():
            first = next(observations, None)
        if first is not None:
            yield first
            yield from observations

    def ground_truth(self) -> GroundTruth | None:
        """Return the source's truth."""
        with self._locked():
            return self._source.ground_truth()

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Wait for the lock; it goes with the process that holds it, however that ends."""
        try:
            import fcntl
        except ImportError:  # Windows: everyone makes its own, and the last one stays
            yield
            return
        with writable(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            file = (self._folder / ".lock").open("w")
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                _log.warning("another process makes a recording in %s: waiting", self._folder)
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError:  # a file system without locks: everyone makes its own
                _log.info("%s cannot be locked", self._folder)
            yield
