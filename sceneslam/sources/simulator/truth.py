"""True scenes: by the light in the zone that the robot is in or enters.

In front of a door, the zone behind it counts as soon as the nearest floor that a camera sees, a
metre ahead, lies there: a robot that looks through a door into the dark is about to be in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.places.floor import BuildingLayout
from sceneslam.types.se3 import Transform
from sceneslam.types.truth import SceneChange

BRIGHT, DARK = "Bright", "Dark"
_AHEAD_M = 1.0  # nearest visible floor of a camera at 0.45 m whose image reaches 25 degrees down
_LIT_LEVEL = 0.5  # threshold on the level of a zone's lamps
_SHORTEST_S = 1.0  # shorter changes are flicker, not a scene


def scene_at(plan: BuildingLayout, T_gt_base: Transform, levels: Mapping[str, float]) -> str | None:
    """Return the scene of the robot's zone, or of the zone behind the door in front of it.

    None outside all zones.
    """
    here_m = T_gt_base[:2, 3]
    ahead_m = here_m + _AHEAD_M * T_gt_base[:2, 0]
    if any(door.is_passed(here_m, ahead_m) for door in plan.doors):
        here_m = ahead_m
    zone = next((one for one in plan.zones if one.holds(*here_m.tolist())), None)
    if zone is None:
        return None
    return BRIGHT if levels[zone.group] > _LIT_LEVEL else DARK


def changes_of(stamps_ns: NDArray[np.int64], scenes: Sequence[str]) -> tuple[SceneChange, ...]:
    """Return the scene changes of a story, from the scene at each stamp (N,) [ns].

    A scene shorter than a second is replaced by the one before it.
    """
    names = np.asarray(scenes)
    starts = np.flatnonzero(np.append(True, names[1:] != names[:-1]))
    ends_ns = np.append(stamps_ns[starts[1:]], stamps_ns[-1])
    long = starts[(ends_ns - stamps_ns[starts]) >= _SHORTEST_S * 1e9]
    kept = long if len(long) else starts[:1]
    named = [(int(stamps_ns[start]), str(names[start])) for start in kept]
    changes = [next(group) for _, group in groupby(named, key=lambda change: change[1])]
    first = SceneChange(stamp_ns=int(stamps_ns[0]), scene=changes[0][1])
    return (first, *(SceneChange(stamp_ns=at, scene=scene) for at, scene in changes[1:]))
