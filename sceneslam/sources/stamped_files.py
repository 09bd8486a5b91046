"""Lists of stamped files (`stamp_s name`), as the TUM RGB-D benchmark has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text
from sceneslam.types.trajectory import parse_stamp_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class StampedFile:
    """One line of a list."""

    stamp_ns: int
    path: Path


def read_list(path: Path) -> Sequence[StampedFile]:
    """Return the files of a list, sorted by stamp; `#` begins a comment.

    Raises InputError if the list is missing or a line is not a stamp and a name.
    """
    if not path.is_file():
        raise InputError(f"{path.name} is missing: {path.parent}")
    files = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp_ns = parse_stamp_ns(words[0])
            name = words[1].strip()
        except (IndexError, ValueError) as err:
            raise InputError(
                f"line {number}: expected `stamp_s name`, got {line.strip()[:60]!r}: {path}"
            ) from err
        files.append(StampedFile(stamp_ns=stamp_ns, path=path.parent / name))
    return sorted(files, key=lambda file: file.stamp_ns)


def nearest_once(
    wanted_ns: Sequence[int], files: Sequence[StampedFile], tolerance_ns: int
) -> Sequence[StampedFile | None]:
    """Return for each stamp the file nearest in time within the tolerance; each is used once.

    The closest pairs are matched first.
    """
    chosen: list[StampedFile | None] = [None] * len(wanted_ns)
    if not files or not len(wanted_ns):
        return chosen
    by_stamp = sorted(files, key=lambda file: file.stamp_ns)
    stamps = np.array([file.stamp_ns for file in by_stamp])
    wanted = np.array(wanted_ns)
    after = np.searchsorted(stamps, wanted)
    near = np.clip(np.stack([after - 1, after], axis=1), 0, len(stamps) - 1)
    apart = np.abs(stamps[near] - wanted[:, None])
    used: set[int] = set()
    for flat in np.argsort(apart, axis=None, kind="stable").tolist():
        row, column = divmod(flat, 2)
        index = int(near[row, column])
        if apart[row, column] > tolerance_ns:
            break
        if chosen[row] is None and index not in used:
            chosen[row] = by_stamp[index]
            used.add(index)
    return chosen
