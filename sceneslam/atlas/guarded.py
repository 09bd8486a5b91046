"""The covariances and the map at the end of a run: where one fails, the rest is still saved."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sceneslam.atlas.atlas import Atlas
from sceneslam.types.errors import text_of
from sceneslam.types.maps import HybridMap, PointLayer
from sceneslam.types.rig import Wheels

_log = logging.getLogger(__name__)


def covariances_of(
    atlas: Atlas, fault: Callable[[str], None], *, wheels: Wheels | None
) -> NDArray[np.float64]:
    """Return the covariances (N, 6, 6) of the trajectory; (0, 6, 6) and a fault if they fail.

    `wheels` are those of the run's odometry, None without it.
    """
    try:
        return atlas.covariances(wheels)
    except Exception as error:
        _log.info("covariances", exc_info=error)
        fault(f"the trajectory has no covariances: {text_of(error)}")
        return np.zeros((0, 6, 6))


def fused_map_of(atlas: Atlas, fault: Callable[[str], None]) -> HybridMap:
    """Return the fused map; an empty one and a fault if fusion fails."""
    try:
        return atlas.fuse_maps()
    except Exception as error:
        _log.info("the maps could not be fused", exc_info=error)
        fault(f"the maps could not be fused: {text_of(error)}")
        nothing = PointLayer(points=np.zeros((0, 3), np.float32))
        return HybridMap(points=nothing, point_modules=np.zeros(0, np.uint8), modules=())
