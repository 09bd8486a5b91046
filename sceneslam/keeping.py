"""Data of a run that are written while it runs: journal, events, and reserved disk space."""

from __future__ import annotations

from pathlib import Path

from sceneslam.config.build import RunParts
from sceneslam.results import Results
from sceneslam.storage.events import EventLog
from sceneslam.storage.journal import JOURNAL, Journal, JournalHeader
from sceneslam.storage.reserve import Reserve
from sceneslam.storage.syncing import Syncing
from sceneslam.types.errors import ConfigError, text_of


class Keeping:
    """Writes the data from which `python -m sceneslam.recover` restores an interrupted run."""

    def __init__(self, parts: RunParts, results: Results) -> None:
        folder, self._faults = results.folder, results.faults
        head = JournalHeader(
            title=results.title,
            value_label=results.value_label,
            wheels=parts.rig.odometry,
            began_in=str(Path.cwd()),
        )
        try:
            self._reserve = Reserve(folder / "reserve.bin")
            self.events = EventLog(folder / "events.jsonl", self._reserve.lend)
            self._journal = Journal(folder / JOURNAL, head, self._reserve.lend)
        except OSError as error:
            allowed = f"a folder that can be written ({text_of(error)})"
            raise ConfigError("folder", str(folder), allowed) from error
        self._syncing = Syncing(self._journal.sync, self.events.sync)
        parts.atlas.keep_journal(self._journal)

    def keep(self) -> None:
        """Flush all data of an observation."""
        self._journal.flush()
        self.events.flush()

    def has_room(self, poses: int) -> bool:
        """Tell whether the disk has space for the results of `poses` poses."""
        return self._reserve.is_enough(poses)

    def finish(self) -> None:
        """Release the reserved disk space for the results."""
        self._syncing.close()
        self._journal.flush()
        self._reserve.release()
        self.events.close()
        self._faults += [fault for fault in (self.events.fault, self._journal.fault) if fault]

    def close(self, *, is_saved: bool) -> None:
        """Close all files; the journal is removed if the results are saved."""
        self._syncing.close()
        self._reserve.release()
        self.events.close()
        if is_saved:
            self._journal.remove()
        else:
            self._journal.close()
