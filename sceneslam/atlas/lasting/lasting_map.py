"""Load a run's map, save it at intervals, and save it at the end."""

from __future__ import annotations

import logging
from concurrent.futures import Executor, Future
from pathlib import Path

from sceneslam.atlas.lasting.map_files import (
    OLD,
    check_map_folder,
    read_map_files,
    save_map_files,
    seal_of,
)
from sceneslam.atlas.lasting.saved_map import SavedMap, forget_contradicted
from sceneslam.atlas.mapper import Mapper
from sceneslam.executors import InStep, executor
from sceneslam.types.errors import ConfigError, InputError, text_of
from sceneslam.types.run import Note

_log = logging.getLogger(__name__)

LOCALIZE, EXTEND, UPDATE = "localize", "extend", "update"


class LastingMap:
    """The settings `load`, `save`, `mode` and `save_every_s` of the atlas."""

    def __init__(
        self, *, load: str | None, save: str | None, mode: str, save_every_s: float
    ) -> None:
        """Load the map `load`, if given; raises ConfigError if that fails."""
        if mode not in (LOCALIZE, EXTEND, UPDATE):
            raise ConfigError("mode", mode, f"{LOCALIZE} | {EXTEND} | {UPDATE}")
        if mode == LOCALIZE and save is not None:
            raise ConfigError(
                "save", save, f"null where atlas.mode is {LOCALIZE}: the map stays as it is"
            )
        if mode != EXTEND and load is None:
            raise ConfigError("mode", mode, f"{EXTEND} where no map is loaded (atlas.load=FOLDER)")
        if not save_every_s > 0:
            raise ConfigError("save_every_s", save_every_s, "seconds above 0")
        self._mode, self._every_ns = mode, round(save_every_s * 1e9)
        self._save, self._load = _folder(save), _folder(load)
        self.loaded: SavedMap | None = None
        self.faults: list[str] = []
        self._saved_ns: int | None = None
        self._executor: Executor = InStep()
        self._writing: Future[bool] | None = None
        self._seal: str | None = None  # of the map that this run takes the place of
        try:
            if self._load is not None:
                self.loaded, seal = read_map_files(self._load)
                self.loaded.check_size()
                self._seal = seal if self._load == self._save else None
        except (InputError, OSError) as error:
            allowed = f"the folder of a saved map ({text_of(error)})"
            raise ConfigError("load", str(load), allowed) from error
        try:
            if self._save is not None:
                check_map_folder(self._save)
        except (InputError, OSError) as error:
            allowed = f"a folder that is empty or holds a map ({text_of(error)})"
            raise ConfigError("save", str(save), allowed) from error

    @property
    def saves(self) -> bool:
        """Tell whether the run is saved."""
        return self._save is not None

    def open(self, *, is_live: bool) -> None:
        """Begin; a live run saves in another thread."""
        self._executor = executor("save", is_live=is_live)

    def keep(self, stamp_ns: int, mapper: Mapper) -> None:
        """Save if `save_every_s` have passed since the last time, once there is what to save."""
        if self._saved_ns is None:
            self._saved_ns = stamp_ns
        if self._save is None or stamp_ns - self._saved_ns < self._every_ns:
            return
        is_writing = self._writing is not None and not self._writing.done()
        if mapper.has_submaps and not is_writing:
            self._saved_ns = stamp_ns
            self._writing = self._executor.submit(self._write, mapper.saved())

    def map_of(self, mapper: Mapper) -> SavedMap:
        """Return the map including the run, as it would be saved."""
        return self._updated(mapper.saved(), mapper.is_found)

    def finish(self, mapper: Mapper, stamp_ns: int, note: Note) -> None:
        """Save at the end, and report if the run was not located in the loaded map."""
        if self._load is not None and not mapper.is_found:
            what = "was found in, and contradicted by," if mapper.was_found else "was not found in"
            self.faults.append(
                f"the run {what} the map {self._load}, its poses are in its own frame"
            )
        self._executor.shutdown()
        if self._save is None:
            return
        saved = mapper.saved()
        if not saved.submaps and seal_of(self._save) is not None:
            self._fault(f"the run has nothing to save, the map that was in {self._save} stays")
        elif self._write(saved, is_found=mapper.is_found):
            loops = sum(edge.is_loop for edge in saved.edges)
            note("map_saved", stamp_ns, submaps=len(saved.submaps), loops=loops)
            if saved.apart:
                _log.warning(
                    "the map %s has %d piece%s that nothing joined to the first: a run that loads "
                    "it searches that one alone; `python -m sceneslam.maps merge` may join them",
                    self._save,
                    saved.apart,
                    "s" * (saved.apart > 1),
                )

    def close(self) -> None:
        """Wait for a map that is being saved, and save no other. May be called twice."""
        self._executor.shutdown()

    def _updated(self, saved: SavedMap, is_found: bool) -> SavedMap:
        if self._mode == UPDATE and self.loaded is not None and is_found:
            return forget_contradicted(saved, self.loaded.runs)
        return saved

    def _write(self, saved: SavedMap, *, is_found: bool = False) -> bool:
        """Save a map; return whether it was possible.

        `is_found`: the run is over, and located. While it goes on, its place may be withdrawn, so
        that nothing which it contradicts is forgotten.
        """
        assert self._save is not None
        try:
            updated = self._updated(saved, is_found)
            updated.check_size()  # no run could load it again
            files = save_map_files(updated, self._save, known=self._seal)
        except Exception as error:  # the run and its poses do not depend on it
            _log.info("save", exc_info=error)
            self._fault(f"the map could not be saved: {text_of(error)}")
            return False
        if files.displaced is not None:
            kept = f"the map that was in {self._save} is kept, its head is {OLD} there"
            if self._seal is None:
                _log.warning(kept)
            else:
                self._fault(f"another run saved its map meanwhile: {kept}")
        self._seal = files.seal
        return True

    def _fault(self, fault: str) -> None:
        if fault not in self.faults:
            self.faults.append(fault)


def _folder(path: str | None) -> Path | None:
    return None if path is None else Path(path).expanduser().resolve()
