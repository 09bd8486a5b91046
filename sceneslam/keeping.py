"""Keeps a run on disk while it goes: its journal, its events, and room for its results."""

from __future__ import annotations

from pathlib import Path

from sceneslam.bus.events import EventLog
from sceneslam.config.build import RunParts
from sceneslam.results import Results
from sceneslam.storage.journal import JOURNAL, Journal, JournalHeader
from sceneslam.storage.reserve import Reserve
from sceneslam.storage.syncing import Syncing
from sceneslam.types.errors import ConfigError, told
from sceneslam.types.rig import Sensor


class Keeping:
    """What `python -m sceneslam.recover` makes the results of, should the run be cut off."""

    def __init__(self, parts: RunParts, results: Results) -> None:
        folder, self._faults = results.folder, results.faults
        head = JournalHeader(
            title=results.title,
            value_label=results.value_label,
            has_odometry=Sensor.ODOMETRY in parts.rig.sensors,
            began_in=str(Path.cwd()),
        )
        try:
            self._reserve = Reserve(folder / "reserve.bin")
            self.events = EventLog(folder / "events.jsonl", self._reserve.lend)
            self._journal = Journal(folder / JOURNAL, head, self._reserve.lend)
        except OSError as error:
            allowed = f"a folder that can be written ({told(error)})"
            raise ConfigError("folder", str(folder), allowed) from error
        self._syncing = Syncing(self._journal.sync, self.events.sync)
        parts.atlas.keep_journal(self._journal)

    def keep(self, stamp_ns: int) -> None:
        """Hand all that came of an observation to the system."""
        self._journal.add_observation(stamp_ns)
        self._journal.flush()
        self.events.flush()

    def has_room(self, poses: int) -> bool:
        """Tell whether the disk holds the results of so many poses, which come before all else."""
        return self._reserve.is_enough(poses)

    def finish(self) -> None:
        """Make room for the results, once nothing more is kept but them."""
        self._syncing.close()
        self._journal.flush()
        self._reserve.release()
        self.events.close()
        self._faults += [fault for fault in (self.events.fault, self._journal.fault) if fault]

    def close(self, *, is_saved: bool) -> None:
        """Close everything; the journal goes where the results say all that it says."""
        self._syncing.close()
        self._reserve.release()
        self.events.close()
        if is_saved:
            self._journal.remove()
        else:
            self._journal.close()
