"""The event log: every vote, decision and hand-over, one JSON object per line."""

from __future__ import annotations

import json
import logging
import math
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.files import LogFile
from sceneslam.types.run import Event, SessionStart

_log = logging.getLogger(__name__)
_PACK = 512  # events that are compressed at a time: a vote takes 30 bytes then


class EventLog:
    """Collects events in memory and writes them to `events.jsonl` as they occur.

    The newest stay as they are, older ones are kept compressed. All events but `cost` depend on
    the recording and the configuration alone.
    """

    def __init__(
        self, path: Path | None = None, make_room: Callable[[], bool] = lambda: False
    ) -> None:
        self._packed: list[bytes] = []  # _PACK events each, the oldest first
        self._newest: list[Event] = []  # those after them
        self._written = 0  # how many of the newest are in the file
        self._file = LogFile(path, make_room) if path else None
        self.last_fault = ""

    @property
    def fault(self) -> str:
        """Return why the file ends before the run, "" if it is complete."""
        return self._file.fault if self._file is not None else ""

    @property
    def events(self) -> tuple[Event, ...]:
        """Return all events so far."""
        packed = [event for pack in self._packed for event in _unpacked(pack)]
        return (*packed, *self._newest)

    def since(self, count: int) -> list[Event]:
        """Return the events after the first `count`."""
        first = count - _PACK * len(self._packed)
        return self._newest[first:] if first >= 0 else list(self.events[count:])

    def add(self, event: str, stamp_ns: int, **fields: Any) -> None:
        """Record an event; NaN becomes null. All but votes are written at once."""
        line: dict[str, Any] = {"event": event, "stamp_ns": stamp_ns}
        for key, value in fields.items():
            line[key] = None if isinstance(value, float) and not math.isfinite(value) else value
        self._newest.append(line)
        if event == "fault":
            self.last_fault = str(fields["what"])
        if event != "vote":
            self.flush()

    def add_fault(self, stamp_ns: int, what: str) -> None:
        """Record what failed, and warn of it."""
        _log.warning(what)
        self.add("fault", stamp_ns, what=what)

    def flush(self) -> None:
        """Write pending events to disk; if that fails, they stay in memory."""
        if self._file is not None:
            lines = [json.dumps(line) + "\n" for line in self._newest[self._written :]]
            if lines:
                self._file.append("".join(lines).encode())
        self._written = len(self._newest)
        if self._written >= 2 * _PACK:
            self._pack()

    def sync(self) -> None:
        """Wait until written events would survive a loss of power; any thread may call it."""
        if self._file is not None:
            self._file.sync()

    def close(self) -> None:
        """Close the file. May be called twice."""
        self.flush()
        if self._file is not None:
            self._file.close()

    def _pack(self) -> None:
        oldest, self._newest = self._newest[:_PACK], self._newest[_PACK:]
        self._written -= _PACK
        self._packed.append(zlib.compress(json.dumps(oldest).encode()))


def log_uncertainty(
    log: EventLog, starts: Iterable[SessionStart], covariances: NDArray[np.float64]
) -> None:
    """Log the standard deviations of the pose where each session begins, as known at the end.

    `covariances` (N, 6, 6) are those of the trajectory's poses, in `base`, translation first.
    """
    for start in starts:
        covariance = covariances[start.row]
        log.add(
            "uncertainty",
            start.stamp_ns,
            session=start.session,
            module=start.module,
            deviation_m=float(np.sqrt(np.trace(covariance[:3, :3]))),
            deviation_rad=float(np.sqrt(np.trace(covariance[3:, 3:]))),
            covariance=covariance.tolist(),
        )


def _unpacked(pack: bytes) -> list[Event]:
    events: list[Event] = json.loads(zlib.decompress(pack))
    return events
