"""Map layers that modules build and the atlas fuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196  # map_server's own defaults


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointLayer:
    """A point cloud, with colours if the module has them."""

    points: NDArray[np.float32]  # (N, 3) [m]
    colors_bgr: NDArray[np.uint8] | None = None  # (N, 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridLayer:
    """An occupancy grid; row 0 is the lowest y, column 0 the lowest x, 0 log odds is unknown."""

    log_odds: NDArray[np.float32]  # (rows, columns)
    resolution_m: float
    origin_xy_m: tuple[float, float]  # outer corner of cell (0, 0)

    def trinary(self, *, occupied: int, free: int, unknown: int) -> NDArray[np.int16]:
        """Return a value per cell (rows, columns), as map_server tells them apart.

        A cell between both thresholds is unknown.
        """
        values = np.full(self.log_odds.shape, unknown, np.int16)
        values[self.log_odds > _log_odds(OCCUPIED_THRESHOLD)] = occupied
        values[self.log_odds < _log_odds(FREE_THRESHOLD)] = free
        return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanLayer:
    """Planar scans of keyframes: the grid is drawn of them where the atlas knows the poses best.

    Beam i of scan k has the angle angle_min_rad[k] + i angle_step_rad[k]. A range is 0 without a
    measurement, negative where there was no return: -3 is free for 3 m.
    """

    stamps_ns: NDArray[np.int64]  # (K,)
    T_world_laser: NDArray[np.float64]  # (K, 4, 4), in the layer's frame
    ranges_m: NDArray[np.float32]  # (K, B)
    angle_min_rad: NDArray[np.float64]  # (K,)
    angle_step_rad: NDArray[np.float64]  # (K,)
    cell_m: float  # of the grid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseGraphLayer:
    """Keyframes or submaps, and what was measured between them. Node i is row i, by rising stamp.

    The information is the inverse covariance of se3.log(T_from_to) about the measurement.
    """

    stamps_ns: NDArray[np.int64]  # (N,)
    T_world_base: NDArray[np.float64]  # (N, 4, 4), in the layer's frame
    edges: NDArray[np.int64]  # (M, 2), nodes from and to
    T_from_to: NDArray[np.float64]  # (M, 4, 4), as measured
    information: NDArray[np.float64]  # (M, 6, 6) [1/m^2, 1/rad^2]
    is_loop: NDArray[np.bool_]  # (M,): a loop closure, not consecutive nodes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LandmarkLayer:
    """Points that a module recognizes when it sees them again."""

    points: NDArray[np.float32]  # (N, 3) [m]
    first_stamps_ns: NDArray[np.int64]  # (N,), of the keyframe that saw it first
    sightings: NDArray[np.int64]  # (N,), how often it was found


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapLayers:
    """The map of one module, in its `local` frame."""

    points: PointLayer | None = None
    grid: GridLayer | None = None
    scans: ScanLayer | None = None
    pose_graph: PoseGraphLayer | None = None
    landmarks: LandmarkLayer | None = None


LAYER_TYPES: dict[str, type] = {  # by the fields of MapLayers
    "points": PointLayer,
    "grid": GridLayer,
    "scans": ScanLayer,
    "pose_graph": PoseGraphLayer,
    "landmarks": LandmarkLayer,
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HybridMap:
    """The map of a run, in `map`: the layers of all modules, and one grid."""

    points: PointLayer
    point_modules: NDArray[np.uint8]  # (N,), index into `modules`: who saw the point
    modules: tuple[str, ...]  # keys in `slam`
    grid: GridLayer | None = None
    pose_graph: PoseGraphLayer | None = None  # of the submaps of all modules
    landmarks: LandmarkLayer | None = None
    landmark_modules: NDArray[np.uint8] | None = None  # (N,), as `point_modules`


def _log_odds(probability: float) -> float:
    return float(np.log(probability / (1.0 - probability)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MovedMap:
    """Where loops, or a loaded map, have moved what was drawn of a run. In `map`, in any thread."""

    loaded: Callable[[], GridLayer | None] | None  # draws the loaded map if the run is found in it
    # Where poses (N, 4, 4) of these stamps (N,), as they were reported, are now.
    moved: Callable[[NDArray[np.int64], NDArray[np.float64]], NDArray[np.float64]]
