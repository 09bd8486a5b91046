"""The `genz_icp` SLAM module: GenZ-ICP, point to plane and point to point by what a cloud shows.

Lee, Lim and Han, "GenZ-ICP: Generalizable and Degeneracy-Robust LiDAR Odometry Using an Adaptive
Weighting", RA-L 2025. Of the library the registration, the map and the adaptive threshold are used;
its own pipeline takes no guess, and keeps the voxel size of one run for the next.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Sensor

from .cloud_odometry import CloudLimits, CloudMap, CloudOdometry
from .clouds import Cloud
from .quiet import quiet

_DECIMALS = 9  # kept: its threads add up in any order, which changes the sixteenth
_VOXEL_RANGE_M = (0.02, 2.0)  # of the voxel that adapts; as in the library


class GenzIcp(CloudOdometry):
    """Registers 3D clouds; `conf/slam/genz_icp.yaml` says what the settings are."""

    requires = (frozenset({Sensor.POINTS}), frozenset({Sensor.DEPTH}))

    def __init__(
        self,
        *,
        voxel_m: float | None,
        points_desired: int,
        planarity_max: float,
        threshold_voxels: float,
        motion_min_voxels: float,
        iterations_max: int,
        depth_range_max_m: float,
        depth_stride_px: int,
        limits: CloudLimits,
    ) -> None:
        from importlib.util import find_spec

        if find_spec("genz_icp") is None:
            raise ConfigError("_target_", "GenzIcp", "pip install 'sceneslam[genz_icp]'")
        given = {
            "points_desired": points_desired,
            "planarity_max": planarity_max,
            "threshold_voxels": threshold_voxels,
            "motion_min_voxels": motion_min_voxels,
            "iterations_max": iterations_max,
        }
        for name, value in given.items():
            if not 0 < value < np.inf:
                raise ConfigError(name, value, "above 0")

        def make_map(edge_m: float, range_max_m: float) -> CloudMap:
            return _Map(edge_m, range_max_m, **given)  # type: ignore[arg-type]

        super().__init__(
            make_map,
            limits,
            voxel_m=voxel_m,
            depth_range_max_m=depth_range_max_m,
            depth_stride_px=depth_stride_px,
        )


class _Map:
    """The library's parts, in the order of its pipeline."""

    def __init__(
        self,
        voxel_m: float,
        range_max_m: float,
        *,
        points_desired: int,
        planarity_max: float,
        threshold_voxels: float,
        motion_min_voxels: float,
        iterations_max: int,
    ) -> None:
        from genz_icp.pybind import genz_icp_pybind as parts

        self._parts: Any = parts
        self._voxel_m, self._points_desired = voxel_m, points_desired
        self._map: Any = parts._VoxelHashMap(
            voxel_size=voxel_m,
            max_distance=range_max_m,
            map_cleanup_radius=range_max_m,
            planarity_threshold=planarity_max,
            max_points_per_voxel=1,
        )
        self._registration: Any = parts._Registration(
            max_num_iterations=iterations_max,
            convergence_criterion=1e-4,
            max_num_threads=1,
        )
        self._threshold: Any = parts._AdaptiveThreshold(
            initial_threshold=threshold_voxels * voxel_m,
            min_motion_th=motion_min_voxels * voxel_m,
            max_range=range_max_m,
        )

    def register(
        self, cloud: Cloud, T_local_guess: se3.Transform, observation: Observation
    ) -> se3.Transform:
        """Return T_local_base of a cloud in base."""
        thinned = self._thinned(cloud, self._voxel_m)
        adapted_m = self._voxel_m * len(thinned) / self._points_desired
        self._voxel_m = float(np.clip(adapted_m, *_VOXEL_RANGE_M))
        dense = self._thinned(cloud, max(0.5 * self._voxel_m, _VOXEL_RANGE_M[0]))
        source = self._thinned(dense, self._voxel_m)
        sigma_m = self._threshold._compute_threshold()
        with quiet():  # it draws a page of status at every scan
            T_local_base = self._registration._align_points_to_map(
                points=self._parts._Vector3dVector(source),
                voxel_map=self._map,
                initial_guess=T_local_guess,
                max_correspondance_distance=3.0 * sigma_m,
                kernel=sigma_m / 3.0,
            )
        self._dense, self._T_local_guess = dense, T_local_guess
        return np.asarray(np.round(np.asarray(T_local_base), _DECIMALS), np.float64)

    def accept(self, T_local_base: se3.Transform) -> None:
        """Add the last cloud to the map, and learn how good guesses are."""
        deviation = se3.inverse(self._T_local_guess) @ T_local_base
        self._threshold._update_model_deviation(model_deviation=deviation)
        self._map._update(self._parts._Vector3dVector(self._dense), T_local_base)

    def points(self) -> NDArray[Any]:
        """Return the map's points (N, 3) [m], local."""
        return np.asarray(self._map._point_cloud()).reshape(-1, 3)

    def _thinned(self, cloud: Cloud, voxel_m: float) -> Cloud:
        points = self._parts._Vector3dVector(cloud)
        return np.asarray(self._parts._voxel_down_sample(points, voxel_m)).reshape(-1, 3)
