"""Which scene the light truly makes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from sceneslam.types.truth import SceneChange

BRIGHT, DARK = "Bright", "Dark"
_THRESHOLD = 100.0  # the paper's, on the grey mean of a frame without noise
_SHORTEST_S = 1.0  # what is over sooner is a flicker, not a scene


def scenes_of(stamps_ns: NDArray[np.int64], grey_means: Sequence[float]) -> tuple[SceneChange, ...]:
    """Return the scenes of a story: grey mean above the threshold is Bright, else Dark.

    A stretch shorter than a second belongs to the scene before it.
    """
    bright = np.asarray(grey_means) > _THRESHOLD
    starts = np.flatnonzero(np.diff(bright, prepend=not bright[0]))
    ends_ns = np.append(stamps_ns[starts[1:]], stamps_ns[-1])
    long = starts[(ends_ns - stamps_ns[starts]) >= _SHORTEST_S * 1e9]
    kept = long if len(long) else starts[:1]
    named = [(int(stamps_ns[start]), BRIGHT if bright[start] else DARK) for start in kept]
    changes = [next(group) for _, group in groupby(named, key=lambda change: change[1])]
    first = SceneChange(stamp_ns=int(stamps_ns[0]), scene=changes[0][1])
    return (first, *(SceneChange(stamp_ns=at, scene=scene) for at, scene in changes[1:]))
