"""The `genz_icp` SLAM module: GenZ-ICP, adaptive point-to-plane and point-to-point registration.

Lee, Lim and Han, "GenZ-ICP: Generalizable and Degeneracy-Robust LiDAR Odometry Using an Adaptive
Weighting", RA-L 2025. Of the library the registration, the map and the adaptive threshold are used;
its pipeline accepts no initial guess, and keeps the voxel size across runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_above, ranged

from .cloud_map import CloudMap
from .cloud_odometry import CloudOdometry
from .clouds import Cloud, CloudReader
from .quiet import quiet

_DECIMALS = 9  # rounding of results: the library's sums depend on the order of its threads
_VOXEL_RANGE_M = (0.02, 2.0)  # limits of the adaptive voxel size, as in the library


@dataclass(kw_only=True, eq=False)
class GenzIcp(CloudOdometry):
    """Registers 3D clouds; the settings are described in `conf/slam/genz_icp.yaml`."""

    library: ClassVar[str | None] = "genz_icp"
    points_desired: int = ranged(check_above, 0)
    planarity_max: float = ranged(check_above, 0)
    initial_threshold_m: float | None = ranged(check_above, 0)
    motion_min_m: float | None = ranged(check_above, 0)
    iterations_max: int = ranged(check_above, 0)

    def make_map(self, voxel_m: float, reader: CloudReader) -> CloudMap:
        """Return the library's map."""
        return _GenzMap(self, voxel_m, reader)


class _GenzMap(CloudMap):
    """The library's parts, in the order of its pipeline."""

    def __init__(self, settings: GenzIcp, voxel_m: float, reader: CloudReader) -> None:
        from genz_icp.pybind import genz_icp_pybind as parts

        range_max_m = reader.range_m[1]
        super().__init__(voxel_m=voxel_m, range_max_m=range_max_m)
        self.capture_m = settings.initial_threshold_m or 2.0 * voxel_m
        self._parts: Any = parts
        self._voxel_m, self._points_desired = voxel_m, settings.points_desired
        self._map: Any = parts._VoxelHashMap(
            voxel_size=voxel_m,
            max_distance=range_max_m,
            map_cleanup_radius=range_max_m,
            planarity_threshold=settings.planarity_max,
            max_points_per_voxel=1,
        )
        self._registration: Any = parts._Registration(
            max_num_iterations=settings.iterations_max,
            convergence_criterion=1e-4,
            max_num_threads=1,
        )
        self._threshold: Any = parts._AdaptiveThreshold(
            initial_threshold=self.capture_m,
            min_motion_th=settings.motion_min_m or 0.1 * voxel_m,
            max_range=range_max_m,
        )

    def register(
        self, cloud: Cloud, T_local_guess: se3.Transform, observation: Observation
    ) -> se3.Transform:
        """Return T_local_base (4, 4) [m] of a cloud (N, 3) [m], base."""
        thinned = self._thinned(cloud, self._voxel_m)
        adapted_m = self._voxel_m * len(thinned) / self._points_desired
        self._voxel_m = float(np.clip(adapted_m, *_VOXEL_RANGE_M))
        self.dense = self._thinned(cloud, max(0.5 * self._voxel_m, _VOXEL_RANGE_M[0]))
        self.source = self._thinned(self.dense, self._voxel_m)
        sigma_m = self._threshold._compute_threshold()
        with quiet():  # it prints its status at every scan
            T_local_base = self._registration._align_points_to_map(
                points=self._parts._Vector3dVector(self.source),
                voxel_map=self._map,
                initial_guess=T_local_guess,
                max_correspondance_distance=3.0 * sigma_m,
                kernel=sigma_m / 3.0,
            )
        return np.asarray(np.round(np.asarray(T_local_base), _DECIMALS), np.float64)

    def add(self, T_local_guess: se3.Transform, T_local_base: se3.Transform) -> None:
        """Add the last cloud to the map, and update the adaptive threshold."""
        deviation = se3.inverse(T_local_guess) @ T_local_base
        self._threshold._update_model_deviation(model_deviation=deviation)
        self._map._update(self._parts._Vector3dVector(self.dense), T_local_base)

    def points(self) -> NDArray[Any]:
        """Return the map's points (N, 3) [m], local."""
        return np.asarray(self._map._point_cloud()).reshape(-1, 3)

    def _thinned(self, cloud: Cloud, voxel_m: float) -> Cloud:
        points = self._parts._Vector3dVector(cloud)
        return np.asarray(self._parts._voxel_down_sample(points, voxel_m)).reshape(-1, 3)
