"""The vertical directions that hold submaps upright, in one map of several runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.submaps.graph import Upright
from sceneslam.atlas.submaps.submap import Submap
from sceneslam.motion.tilt import upright
from sceneslam.types import se3


def uprights(
    submaps: Sequence[Submap], T_map_node: NDArray[np.float64], nodes: Sequence[int]
) -> list[Upright]:
    """Return the vertical directions that were measured at `nodes`, which lie in one map.

    The first one gives that of the map. Base is level most of the time: a sensor that is mounted
    askew has the same tilt in a whole run.
    """
    ups = _straight(submaps, nodes)
    if not ups:
        return []
    first, up_first = next(iter(ups.items()))
    up_map = T_map_node[first, :3, :3] @ up_first
    return [Upright(node=node, up_node=up, up_map=up_map) for node, up in ups.items()]


def _straight(submaps: Sequence[Submap], nodes: Sequence[int]) -> dict[int, NDArray[np.float64]]:
    """Return the directions (3,) by node, each without what is usual in its run."""
    measured: dict[int, dict[int, NDArray[np.float64]]] = {}  # by run, and node
    for node in nodes:
        run, up = submaps[node].run, submaps[node].up
        if up is not None:
            measured.setdefault(run, {})[node] = up
    straight = dict[int, NDArray[np.float64]]()
    for ups in measured.values():
        askew = upright(se3.identity(), np.median(list(ups.values()), axis=0))[:3, :3]
        straight |= {node: askew @ up for node, up in ups.items()}
    return straight
