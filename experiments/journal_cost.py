"""What keeping a run on disk costs per observation: `python experiments/journal_cost.py [FOLDER]`.

In microseconds of this process's CPU, beside what a write of as many bytes costs by itself.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time_ns

import numpy as np

from sceneslam.storage.events import EventLog
from sceneslam.storage.journal import Journal, JournalHeader
from sceneslam.storage.syncing import Syncing

_OBSERVATIONS = 20_000


def main(folder: Path) -> None:
    """Print the table."""
    head = JournalHeader(title="cost", value_label="", wheels=None, began_in="")
    journal = Journal(folder / "journal.bin", head)
    log = EventLog(folder / "events.jsonl")
    syncing = Syncing(journal.sync, log.sync)
    pose, covariance = np.eye(4), np.eye(6)

    def keep(stamp_ns: int) -> None:
        journal.add_local(stamp_ns, pose)
        journal.add_pose(stamp_ns, pose, "bright", covariance, None)
        journal.add_observation(stamp_ns)
        journal.flush()

    def vote(stamp_ns: int) -> None:
        log.add("vote", stamp_ns, scene="Bright", value=123.4)
        log.flush()

    plain = os.open(folder / "plain.bin", os.O_WRONLY | os.O_CREAT)
    for name, work in (
        ("journal", keep),
        ("vote", vote),
        ("a write of 410 bytes", lambda _: os.write(plain, bytes(410))),
    ):
        print(f"{name}: {_cost_us(work):.1f} us per observation")
    syncing.close()
    size = (folder / "journal.bin").stat().st_size / _OBSERVATIONS
    print(f"journal: {size:.0f} bytes per observation")


def _cost_us(work: Callable[[int], object]) -> float:
    began_ns = process_time_ns()
    for stamp_ns in range(_OBSERVATIONS):
        work(stamp_ns)
    return (process_time_ns() - began_ns) / 1e3 / _OBSERVATIONS


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else ".") as made:
        main(Path(made))
