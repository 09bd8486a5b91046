"""Write `results/README/stories.csv` from a sweep over stories.

python -m sceneslam -m +scenario=bright_to_dark,dark_to_bright,... hydra.sweep.dir=SWEEP
python experiments/stories.py SWEEP
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

OUT = Path(__file__).parent / "results" / "README" / "stories.csv"
COLUMNS = (
    *("scenario", "path [m]", "ATE RMSE (max) [m]", "coverage", "Correct Rate"),
    *("switches: why, after the true change", "false switches"),
)


def row(folder: Path) -> list[str]:
    """Return one run's line."""
    metrics = json.loads((folder / "metrics.json").read_text())
    words = json.loads((folder / "job.json").read_text())["overrides"]
    named = (w.partition("=")[2] for w in words if w.lstrip("+").startswith("scenario="))
    if not (scenario := next(named, "")):
        raise SystemExit(f"error: expected runs of +scenario=NAME, got {words}: {folder}")
    return [
        scenario,
        f"{metrics['path_length_m']:.1f}",
        f"{metrics['ate_rmse_m']:.3f} ({metrics['ate_max_m']:.3f})",
        f"{metrics['coverage']:.0%}",
        f"{metrics['correct_rate']:.1%}",
        "; ".join(switch(one) for one in metrics["switches"]) or "none",
        "-" if metrics["false_switches"] is None else str(metrics["false_switches"]),
    ]


def switch(one: dict[str, Any]) -> str:
    """Return why a module was replaced, and how long after the true change of scene."""
    if one["confirm_delay_s"] is None:
        return str(one["reason"])
    return f"{one['reason']}, {one['confirm_delay_s']:.2f} s"


def main(sweep: Path) -> None:
    """Write the table."""
    found = sorted(sweep.glob("*/metrics.json"), key=lambda path: int(path.parent.name))
    if not found:
        raise SystemExit(f"error: no run in the folder of a sweep: {sweep}")
    rows = [row(path.parent) for path in found]  # before the old table is gone
    with OUT.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
