"""What the experiments of the paper read from a run's folder."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from sceneslam.types.experiment import TrialResult


def events_of(outcome: TrialResult, kind: str) -> Iterator[Mapping[str, Any]]:
    """Yield the events of one kind from a run's log."""
    with (outcome.folder / "events.jsonl").open() as file:
        for line in file:
            if f'"event": "{kind}"' in line:
                yield json.loads(line)


def keep_figure(outcome: TrialResult, figure: str, path: Path) -> None:
    """Copy one of the run's own figures, where it drew it."""
    drawn = outcome.folder / "figures" / f"{figure}.png"
    if drawn.is_file():
        shutil.copyfile(drawn, path)


def number(value: float | None) -> float:
    """Return a metric, NaN where it is not known."""
    return math.nan if value is None else float(value)
