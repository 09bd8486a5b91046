"""Continue a sweep that was stopped: `python -m sceneslam.sweep DIR`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from sceneslam.streams import secure_streams
from sceneslam.sweep.sweep import resume
from sceneslam.types.errors import SceneSlamError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the missing jobs; return the exit code: 0 all complete, 1 not all, 2 no sweep."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    if len(words) != 1 or words[0].startswith("-"):
        print("usage: python -m sceneslam.sweep DIR (the folder of a sweep)", file=sys.stderr)
        return 2
    try:
        return 0 if resume(Path(words[0]).absolute()) else 1
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
