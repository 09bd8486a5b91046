"""Print how far a person who walks through the view leads a visual module astray.

    python experiments/moving_things.py MODULE [OVERRIDES]

MODULE is `rgbd`, `direct` or `depth`; the overrides choose a recording as for a run. Nobody passes
in the first row; the others differ in how far away somebody passes, and how quickly. One line of a
Markdown table each: the mean over `SEEDS`, and the worst of them.
"""

from __future__ import annotations

import sys

import numpy as np
from rgbd_loop import MAX_GAP_S, build, camera_only, follow, poses_of

from sceneslam.evaluation.accuracy import absolute_errors
from sceneslam.types.observation import TrackingStatus

SEEDS = (11, 12, 13)
PASSES = {
    "nobody": ["effects=none"],
    "at 1.2 m, 0.8 m/s": ["effects=passer_by"],
    "at 1.2 m, 0.3 m/s": ["effects=passer_by", "effects.speed_mps=0.3"],
    "at 0.8 m, 1.5 m/s": ["effects=passer_by", "effects.distance_m=0.8", "effects.speed_mps=1.5"],
    "0.8 m wide, at 2 m": ["effects=passer_by", "effects.distance_m=2", "effects.width_m=0.8"],
}


def drive(module_name: str, overrides: list[str], seed: int) -> tuple[float, float, float]:
    """Return the ATE and the largest error [mm], and the share of images not lost [%]."""
    source, module, truth = build([*overrides, f"seed={seed}"], module_name)
    answers, _ = follow(module, (camera_only(observation) for observation in source))
    module.shutdown()
    held = [answer for answer in answers if answer.status is not TrackingStatus.LOST]
    if not held:
        return np.nan, np.nan, 0.0
    told = poses_of(held)
    errors = absolute_errors(told, truth, MAX_GAP_S)
    return 1e3 * errors.rmse_m, 1e3 * errors.max_m, 100.0 * len(held) / len(answers)


def main() -> None:
    """Print the table."""
    module_name, *overrides = sys.argv[1:] or ["rgbd"]
    print("| who passes | ATE (worst) [mm] | largest error [mm] | not lost [%] |")
    print("|---" * 4 + "|")
    for name, passing in PASSES.items():
        runs = np.array([drive(module_name, [*overrides, *passing], seed) for seed in SEEDS])
        ate_mm, most_mm, held = runs.T
        print(
            f"| {name} | {ate_mm.mean():.1f} ({ate_mm.max():.1f}) | {most_mm.max():.0f} "
            f"| {held.mean():.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
