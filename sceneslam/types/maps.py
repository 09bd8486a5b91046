"""Map layers that modules build and the atlas fuses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointLayer:
    """A cloud, with colours where the module saw any."""

    points: NDArray[np.float32]  # (N, 3) [m]
    colors_bgr: NDArray[np.uint8] | None = None  # (N, 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridLayer:
    """An occupancy grid; row 0 is the lowest y, column 0 the lowest x, 0 log odds is unknown."""

    log_odds: NDArray[np.float32]  # (rows, columns)
    resolution_m: float
    origin_xy_m: tuple[float, float]  # outer corner of cell (0, 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapLayers:
    """What one module knows of the world, in its `local` frame."""

    points: PointLayer | None = None
    grid: GridLayer | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HybridMap:
    """The one map of a run, in `map`: every module's points and one grid."""

    points: PointLayer
    point_modules: NDArray[np.uint8]  # (N,), index into `modules`: who saw the point
    modules: tuple[str, ...]  # keys in `slam`
    grid: GridLayer | None = None
