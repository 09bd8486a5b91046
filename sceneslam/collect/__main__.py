"""Make one table of many runs: `python -m sceneslam.collect DIR`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from sceneslam.collect.write import collect
from sceneslam.streams import secure_streams
from sceneslam.types.errors import InputError


def main(arguments: Sequence[str] | None = None) -> int:
    """Collect; return the exit code: 0 written, 2 no run found."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if len(words) != 1 or words[0].startswith("-"):
        print("usage: python -m sceneslam.collect DIR (the folder of a sweep)", file=sys.stderr)
        return 2
    try:
        page = collect(Path(words[0]))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"table    {page.parent}/table.csv\npage     {page}")
    return 0


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
