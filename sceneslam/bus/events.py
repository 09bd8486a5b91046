"""The event log: every vote, decision and hand-over, one JSON object per line."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from sceneslam.types.errors import told
from sceneslam.types.run import Event

_WAITING_MAX = 64  # votes, which are written together


class EventLog:
    """Collects events in memory and writes them to `events.jsonl` as they come.

    All events but `cost` are functions of the recording and the configuration alone.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._events: list[Event] = []
        self._written = 0  # how many of them are in the file
        self._file: TextIO | None = path.open("w") if path else None
        self.fault = ""  # why the file ends before the run did

    @property
    def events(self) -> tuple[Event, ...]:
        """Return all events so far."""
        return tuple(self._events)

    def since(self, count: int) -> list[Event]:
        """Return the events after the first `count`."""
        return self._events[count:]

    def add(self, event: str, stamp_ns: int, **fields: Any) -> None:
        """Record an event; NaN becomes null. All but votes reach the disk at once."""
        line: dict[str, Any] = {"event": event, "stamp_ns": stamp_ns}
        for key, value in fields.items():
            line[key] = None if isinstance(value, float) and not math.isfinite(value) else value
        self._events.append(line)
        if event != "vote" or len(self._events) - self._written >= _WAITING_MAX:
            self._write()

    def close(self) -> None:
        """Close the file. May be called twice."""
        self._write()
        if self._file:
            self._file.close()
            self._file = None

    def _write(self) -> None:
        """Write the events that wait; where the disk does not take them, they stay in memory."""
        lines = [json.dumps(line) + "\n" for line in self._events[self._written :]]
        self._written = len(self._events)
        if self._file is None:
            return
        try:
            self._file.write("".join(lines))
            self._file.flush()
        except OSError as error:
            self.fault = f"events.jsonl is not complete: {told(error)}"
            file, self._file = self._file, None
            with suppress(OSError):  # it tries to write what is left
                file.close()
