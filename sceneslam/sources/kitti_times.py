"""Times of the scans of a KITTI drive."""

from __future__ import annotations

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text

_PERIOD_NS = 100_000_000
_NAMES = ("times.txt", "velodyne_points/timestamps.txt", "timestamps.txt")


def read_times_ns(folder: Path, count: int) -> NDArray[np.int64]:
    """Return the stamps (N,) [ns] of `count` scans; without a file of times, 10 Hz from zero.

    Raises InputError if the file has another number of lines or an invalid time.
    """
    for name in _NAMES:
        path = folder / name
        if path.is_file():
            lines = [line.strip() for line in read_text(path).splitlines()]
            stamps = [_stamp_ns(line, path) for line in lines if line and line[0] != "#"]
            if len(stamps) != count:
                raise InputError(
                    f"times: expected {count} as there are scans, got {len(stamps)}: {path}"
                )
            return np.array(stamps, dtype=np.int64)
    return np.arange(count, dtype=np.int64) * _PERIOD_NS


def _stamp_ns(line: str, path: Path) -> int:
    """Return the stamp [ns] of a line: seconds, or date and time as in the raw drives (as UTC)."""
    try:
        if ":" not in line:
            return int(Decimal(line).scaleb(9))
        day_time, _, fraction = line.replace(" ", "T").partition(".")
        whole = int(np.datetime64(day_time, "s").astype(np.int64))
        return whole * 10**9 + int((fraction + "0" * 9)[:9])
    except (InvalidOperation, ValueError, OverflowError) as err:
        raise InputError(f"times: expected seconds, got {line[:40]!r}: {path}") from err
