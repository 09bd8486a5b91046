"""Print what switching gives, beside each module alone, over the same path.

Run it with the overrides of any source, and the module for the dark:

    python experiments/switched_or_alone.py dark=laser story=bright_to_dark
    python experiments/switched_or_alone.py dark=kiss_icp source=tum_rgbd source.path=FOLDER \
        effects=lights_out

The result is a Markdown table; runs are kept below `outputs/switched_or_alone`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from sceneslam.experiments.scripts import run

FOLDER = Path("outputs/switched_or_alone")
COLUMNS = ("run", "ATE RMSE [m]", "max [m]", "coverage", "correct rate", "x real time")


def measured(name: str, *overrides: str) -> dict[str, Any]:
    """Run SceneSLAM and return its metrics, also of a module that has few poses."""
    folder = run(FOLDER / name, *overrides, "evaluation.coverage_min_ratio=0")
    metrics: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return metrics


def row(name: str, metrics: dict[str, Any]) -> str:
    """Return one line of the table."""
    return (
        f"| {name} | {metrics['ate_rmse_m']:.3f} | {metrics['ate_max_m']:.3f} "
        f"| {metrics['coverage']:.1%} | {metrics['correct_rate']:.1%} "
        f"| {metrics['realtime_factor']:.1f} |"
    )


def main() -> None:
    """Run switched, each module alone, and the light's module with all lights on."""
    dark = next((word[5:] for word in sys.argv[1:] if word.startswith("dark=")), "laser")
    source = [word for word in sys.argv[1:] if not word.startswith("dark=")]
    single = ("+scenario=single", *source)
    table = {
        f"switched: rgbd, then {dark}": measured(
            "switched", "+scenario=bright_to_dark", f"slam@slam.dark={dark}", *source
        ),
        "rgbd alone": measured("rgbd", *single, "slam@slam.only=rgbd"),
        f"{dark} alone": measured(dark, *single, f"slam@slam.only={dark}"),
        "rgbd alone, all lights on": measured("lit", *single, "slam@slam.only=rgbd", "lights=on"),
    }
    print("| " + " | ".join(COLUMNS) + " |")
    print("|---" * len(COLUMNS) + "|")
    for name, metrics in table.items():
        print(row(name, metrics))


if __name__ == "__main__":
    main()
