"""Compare finished runs on one page: `python -m sceneslam.compare RUN RUN ...`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from sceneslam.compare.page import lines, write_page
from sceneslam.compare.runs import read_runs
from sceneslam.storage.folder import RunFolder
from sceneslam.streams import secure_streams
from sceneslam.types.errors import ConfigError, InputError, SceneSlamError


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare; return the exit code: 0 the page is written, 2 a folder is not that of a run."""
    options = _parser().parse_args(arguments)
    out: Path = options.out
    try:
        if len(options.runs) < 2:
            raise InputError(f"two runs or more are compared, got one: {options.runs[0]}")
        runs = read_runs(options.runs)
        if any((out / name).exists() for name in ("trajectory.tum", "journal.bin")):
            raise ConfigError("--out", str(out), "a folder that holds no run")
        with closing(RunFolder.claim(out, kind="comparison", key="--out")) as claimed:
            claimed.clear()
            page = write_page(out, runs)
    except SceneSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join([*lines(runs), f"report  {page}"]))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.compare", description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+", help="the folders of finished runs")
    default = Path("outputs/compare")
    parser.add_argument(
        "--out", type=Path, default=default, help=f"where the page goes ({default})"
    )
    return parser


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
