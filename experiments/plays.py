"""Write a TUM RGB-D recording as it is played another way; images are linked, not copied.

    python experiments/plays.py FOLDER OUT backwards
    python experiments/plays.py FOLDER OUT back_again SHARE SECONDS

`back_again` goes forth and then back by the same images, without the SECONDS that begin at a SHARE
of the way forth: nothing tells how the camera came to where it goes on. Run it as the recording,
with `source.path=OUT`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

from sceneslam.types.errors import InputError
from sceneslam.types.input_files import read_text

LISTS = "rgb.txt", "depth.txt", "groundtruth.txt"
PERIOD_S = 1 / 30  # between the last image forth and the first back

Row = tuple[float, str]  # stamp [s], and the rest of its line
Play = Callable[[list[Row], float, float], list[Row]]  # between a begin and an end [s]


def rows(path: Path) -> list[Row]:
    """Return the rows of a list; raises InputError if one is no stamp and what belongs to it."""
    if not path.is_file():
        raise InputError(f"{path.name} is missing: {path.parent}")
    found = []
    for line in read_text(path).splitlines():
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            stamp_s, rest = float(words[0]), words[1]
        except (IndexError, ValueError) as error:
            raise InputError(f"expected `stamp_s ...`, got {line[:60]!r}: {path}") from error
        found.append((stamp_s, rest))
    return found


def backwards(forth: list[Row], _: float, end_s: float) -> list[Row]:
    """Return rows backwards, after the end."""
    return [(2.0 * end_s + PERIOD_S - stamp_s, rest) for stamp_s, rest in reversed(forth)]


def back_again(share: float, lost_s: float) -> Play:
    """Return the play forth and back without some seconds."""

    def play(forth: list[Row], begin_s: float, end_s: float) -> list[Row]:
        cut_s = begin_s + share * (end_s - begin_s)
        both = [*forth, *backwards(forth, begin_s, end_s)]
        return [row for row in both if not cut_s <= row[0] < cut_s + lost_s]

    return play


def write(folder: Path, out: Path, play: Play) -> None:
    """Write the play of a recording."""
    if out.exists():
        raise InputError(f"is there already: {out}")
    lists = {name: rows(folder / name) for name in LISTS}
    stamps_s = [stamp_s for name in LISTS[:2] for stamp_s, _ in lists[name]]
    begin_s, end_s = min(stamps_s), max(stamps_s)
    out.mkdir(parents=True)
    for name, forth in lists.items():
        within = [row for row in forth if begin_s <= row[0] <= end_s]
        lines = [f"{stamp_s:.6f} {rest}\n" for stamp_s, rest in play(within, begin_s, end_s)]
        (out / name).write_text("".join(lines))
    for images in ("rgb", "depth"):
        (out / images).symlink_to((folder / images).resolve())


def main(folder: str, out: str, name: str, *numbers: str) -> None:
    """Write the play that the words name."""
    if name == "backwards" and not numbers:
        play: Play = backwards
    elif name == "back_again" and len(numbers) == 2:
        play = back_again(*(float(number) for number in numbers))
    else:
        sys.exit(__doc__)
    write(Path(folder), Path(out), play)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except InputError as error:
        sys.exit(f"error: {error}")
