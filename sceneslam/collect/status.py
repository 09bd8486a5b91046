"""The status of a sweep's job: `job.json` in its folder."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from sceneslam.evaluation.shortfalls import NO_POSE, REFERENCE
from sceneslam.types.errors import InputError

_FILE = "job.json"


class State(Enum):
    """The state of a job."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    INCOMPLETE = "incomplete"  # ended early or damaged input; partial results are saved
    FAILED = "failed"  # could not be run
    KILLED = "killed"  # its process died
    STOPPED = "stopped"  # with the sweep, by Ctrl-C or SIGTERM


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """A job's state and overrides."""

    state: State
    config_sha256: str = ""
    overrides: Sequence[str] = ()  # of the job, as on the command line
    error: str = ""
    host: str = ""
    pid: int | None = None
    wall_s: float | None = None

    @property
    def is_finished(self) -> bool:
        """Tell whether it came to its end, so that its metrics count."""
        return self.state in (State.DONE, State.INCOMPLETE)

    @property
    def is_settled(self) -> bool:
        """Tell whether it has ended, in any state."""
        return self.state not in (State.WAITING, State.RUNNING)

    def is_final(self, folder: Path) -> bool:
        """Tell whether another run would give the same: it is done, or lacks nothing but poses.

        Damaged input may be repaired by then, and a disk or memory that was full have room.
        """
        if self.state is not State.INCOMPLETE:
            return self.state is State.DONE
        try:
            said = list[str]()
            if self.error.startswith(REFERENCE):
                said += [f"{REFERENCE}{one}" for one in _missing_poses(folder / "reference")]
            if not self.error.startswith(f"{REFERENCE}{NO_POSE}"):  # else the run did not begin
                said += _missing_poses(folder)
        except (OSError, KeyError, TypeError, ValueError):
            return False
        return self.error == "; ".join(said)

    def now(self, state: State, error: str = "", **values: Any) -> Status:
        """Return the same job in another state."""
        return replace(self, state=state, error=error, **values)

    def write(self, folder: Path) -> None:
        """Write it atomically, since others read it at the same time."""
        part = folder / f"{_FILE}.{os.getpid()}.part"
        part.write_text(json.dumps(asdict(self) | {"state": self.state.value}, indent=2) + "\n")
        part.replace(folder / _FILE)

    @classmethod
    def read(cls, folder: Path) -> Status | None:
        """Return a folder's status, None if it is not a job of a sweep or its file is empty."""
        path = folder / _FILE
        if not path.is_file() or not path.stat().st_size:
            return None
        try:
            values = json.loads(path.read_text())
            return cls(**values | {"state": State(values["state"])})
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"not the status of a job ({error!r}): {path}") from error


def _missing_poses(folder: Path) -> list[str]:
    """Return what a run says of missing poses; nothing if a module failed in it."""
    metrics = json.loads((folder / "metrics.json").read_text())
    without = [one for one in metrics.get("errors", ()) if one.startswith(NO_POSE)]
    return [] if metrics["faults"] else [*without, *metrics["shortfalls"]]
