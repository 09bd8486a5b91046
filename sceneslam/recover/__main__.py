"""Recover the results of a run that was interrupted: `python -m sceneslam.recover RUN`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from sceneslam.config.words import named_targets
from sceneslam.evaluation.report.summary import summary_lines
from sceneslam.recover.recover import recover
from sceneslam.storage.folder import RunFolder
from sceneslam.storage.journal import JOURNAL
from sceneslam.streams import secure_streams
from sceneslam.types.errors import InputError, SceneSlamError, text_of


def main(arguments: Sequence[str] | None = None) -> int:
    """Recover; return the exit code: 0 results are complete, 1 partial, 2 nothing to do."""
    options = _parser().parse_args(arguments)
    folder: Path = options.run.resolve()
    try:
        allowed = named_targets(options.allowed, "recover", "RUN")
        if not folder.is_dir():
            raise InputError(f"not the folder of a run: {folder}")
        if not (folder / JOURNAL).exists() and (folder / "trajectory.tum").exists():
            print(f"nothing to recover, the run came to its end: {folder}")
            return 0
        if not (folder / JOURNAL).exists():
            raise InputError(f"nothing to recover, there is no {JOURNAL}: {folder}")
        with closing(RunFolder.claim(folder)):
            recovered = recover(folder, allowed)
    except (SceneSlamError, OSError) as error:
        said = str(error) if isinstance(error, SceneSlamError) else text_of(error)
        print(f"error: {said}", file=sys.stderr)
        return 2
    for sentence in recovered.missing:
        print(f"missing: {sentence}", file=sys.stderr)
    for fault in recovered.faults:
        print(f"error: {fault}", file=sys.stderr)
    print("\n".join([*summary_lines(recovered.metrics), f"results  {folder}"]))
    return 1 if recovered.faults else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sceneslam.recover", description=__doc__)
    parser.add_argument("run", type=Path, help="the folder of a run that was cut off")
    parser.add_argument(
        "allowed",
        nargs="?",
        metavar="allow_targets=[NAME]",
        help="packages of your own that hold the run's source",
    )
    return parser


if __name__ == "__main__":
    secure_streams()
    sys.exit(main())
