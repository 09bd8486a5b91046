"""What is known of a module in a scene, over all recordings; and the table that follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneslam.evaluation.accuracy import root_mean_square
from sceneslam.experiments.table.stretch import Motions


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """A module in a scene."""

    scene: str
    module: str
    recordings: int  # that show the scene and have the module's sensors
    due: int  # motions that it was asked for
    available: float  # share of them that it gave
    error_m: float  # root mean square of those, NaN of none
    error_rad: float
    score_m: float  # the same over all, each counted as `lost_m` at most, and where it gave none
    frame_ms: float  # median cost per observation, of the wall clock


def weigh(
    module: str,
    scene: str,
    motions: Sequence[Motions],
    *,
    recordings: int,
    lost_m: float,
    frame_ms: float,
) -> Evidence:
    """Return what the motions of a module in a scene amount to."""
    trans_m = np.concatenate([np.zeros(0), *(one.trans_m for one in motions)])
    rot_rad = np.concatenate([np.zeros(0), *(one.rot_rad for one in motions)])
    due = sum(one.due for one in motions)
    capped_m = np.full(max(due, len(trans_m)), lost_m)
    capped_m[: len(trans_m)] = np.minimum(trans_m, lost_m)
    return Evidence(
        scene=scene,
        module=module,
        recordings=recordings,
        due=due,
        available=len(trans_m) / due if due else float("nan"),
        error_m=root_mean_square(trans_m),
        error_rad=root_mean_square(rot_rad),
        score_m=root_mean_square(capped_m),
        frame_ms=frame_ms,
    )


def propose(evidence: Sequence[Evidence], *, fallback_min: float) -> Mapping[str, Sequence[str]]:
    """Return scene -> modules by rising score, the first choice and then its fallbacks.

    A module has to suit every recording that shows the scene. A fallback has to give at least
    `fallback_min` of the motions.
    """
    table = {}
    for scene in dict.fromkeys(one.scene for one in evidence):
        of = [one for one in evidence if one.scene == scene]
        shown = max(one.recordings for one in of)
        fit = [one for one in of if one.recordings == shown and one.available > 0]
        ranked = sorted(fit, key=lambda one: one.score_m)
        table[scene] = [
            one.module for one in ranked if one is ranked[0] or one.available >= fallback_min
        ]
    return table
