"""The vertical directions that hold submaps upright."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.graph import Upright
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.motion.tilt import upright
from sceneslam.types import se3


def straightened(submaps: Sequence[Submap]) -> list[Submap]:
    """Return the submaps of a whole run, their vertical directions without its usual tilt.

    Base is level most of the time: a sensor that is mounted askew has the same tilt everywhere.
    """
    measured = [submap.up for submap in submaps if submap.up is not None]
    if not measured:
        return list(submaps)
    askew = upright(se3.identity(), np.median(measured, axis=0))[:3, :3]
    return [
        submap if submap.up is None else replace(submap, up=askew @ submap.up) for submap in submaps
    ]


def uprights(
    submaps: Sequence[Submap], T_map_node: NDArray[np.float64], nodes: Sequence[int]
) -> list[Upright]:
    """Return the vertical directions of `nodes`, in one map; the first one gives that of the map.

    Those of the submaps are `straightened`.
    """
    ups = {node: up for node in nodes if (up := submaps[node].up) is not None}
    if not ups:
        return []
    first, up_first = next(iter(ups.items()))
    up_map = T_map_node[first, :3, :3] @ up_first
    return [Upright(node=node, up_node=up, up_map=up_map) for node, up in ups.items()]
