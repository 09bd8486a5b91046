"""The `kiss_icp` SLAM module: an adapter over KISS-ICP, for lidars and depth cameras.

Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023. Of the library its parts are
used: its pipeline aborts the process if all stamps are equal or a rotation is off by 1e-10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.ranges import check_above, ranged

from .cloud_map import CloudMap
from .cloud_odometry import CloudOdometry
from .clouds import Cloud, CloudReader


@dataclass(kw_only=True, eq=False)
class KissIcp(CloudOdometry):
    """Registers 3D clouds; the settings are described in `conf/slam/kiss_icp.yaml`."""

    initial_threshold_m: float | None = ranged(check_above, 0)
    motion_min_m: float | None = ranged(check_above, 0)
    points_per_voxel: int = ranged(check_above, 0)
    iterations_max: int = ranged(check_above, 0)

    def make_map(self, voxel_m: float, reader: CloudReader) -> CloudMap:
        """Return the library's map."""
        return _KissMap(self, voxel_m, reader)


class _KissMap(CloudMap):
    """KISS-ICP's parts, combined so that its result is checked before the map is updated."""

    def __init__(self, settings: KissIcp, voxel_m: float, reader: CloudReader) -> None:
        from kiss_icp.config import config as parts
        from kiss_icp.config.parser import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        super().__init__(voxel_m=voxel_m, range_max_m=reader.range_m[1])
        self.capture_m = settings.initial_threshold_m or 2.0 * voxel_m
        # Constructed without validation, since the class would also read environment variables.
        config: Any = KISSConfig.model_construct(
            data=parts.DataConfig(max_range=reader.range_m[1], min_range=0.0, deskew=False),
            mapping=parts.MappingConfig(
                voxel_size=voxel_m, max_points_per_voxel=settings.points_per_voxel
            ),
            registration=parts.RegistrationConfig(
                max_num_iterations=settings.iterations_max,
                convergence_criterion=1e-4,
                max_num_threads=1,  # more threads change the order of sums
            ),
            adaptive_threshold=parts.AdaptiveThresholdConfig(
                fixed_threshold=None,
                initial_threshold=self.capture_m,
                min_motion_th=settings.motion_min_m or (0.3 if reader.is_depth else 0.1) * voxel_m,
            ),
        )
        self._odometry: Any = KissICP(config)
        self._is_given = settings.initial_threshold_m is not None

    def register(
        self, cloud: Cloud, T_local_guess: se3.Transform, observation: Observation
    ) -> se3.Transform:
        """Return T_local_base (4, 4) [m] of a cloud (N, 3) [m], base.

        A guess that may be farther off than the threshold is registered coarsely first.
        """
        self.source, self.dense = self._odometry.voxelize(cloud)
        sigma_m = self._odometry.adaptive_threshold.get_threshold()
        if self.guess_off_m > sigma_m and not self._is_given:
            T_local_guess = self._aligned(T_local_guess, self.guess_off_m)
        return self._aligned(T_local_guess, sigma_m)

    def _aligned(self, T_local_guess: se3.Transform, sigma_m: float) -> se3.Transform:
        """Return T_local_base (4, 4) [m] of the last cloud, by the kernel `sigma_m`."""
        T_local_base = self._odometry.registration.align_points_to_map(
            points=self.source,
            voxel_map=self._odometry.local_map,
            initial_guess=T_local_guess,
            max_correspondance_distance=3.0 * sigma_m,
            kernel=sigma_m,
        )
        return np.array(T_local_base, dtype=np.float64)

    def add(self, T_local_guess: se3.Transform, T_local_base: se3.Transform) -> None:
        """Add the last cloud to the map, and update the adaptive threshold."""
        deviation = se3.inverse(T_local_guess) @ T_local_base
        self._odometry.adaptive_threshold.update_model_deviation(deviation)
        self._odometry.local_map.update(self.dense, T_local_base)

    def points(self) -> NDArray[np.float64]:
        """Return the map's points (N, 3) [m], local."""
        return np.asarray(self._odometry.local_map.point_cloud()).reshape(-1, 3)
