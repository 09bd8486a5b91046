"""KISS-ICP's parts, put together so that its answer can be judged before it joins the map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3

from .cloud_shape import cloud_localizability
from .clouds import Cloud
from .degeneracy import Localizability

_SLOTS = 1 << 20
_SHAPE_POINTS = 10_000  # suffice for the shape of a cloud


class IcpMap:
    """A voxel map, and registration with it; only what is accepted becomes part of the map."""

    def __init__(
        self,
        *,
        voxel_m: float,
        initial_threshold_m: float,
        motion_min_m: float,
        range_max_m: float,
        points_per_voxel: int,
        iterations_max: int,
    ) -> None:
        from kiss_icp.config import config as parts
        from kiss_icp.config.parser import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        # Constructed without validation, since the class would also read the environment.
        config: Any = KISSConfig.model_construct(
            data=parts.DataConfig(max_range=range_max_m, min_range=0.0, deskew=False),
            mapping=parts.MappingConfig(voxel_size=voxel_m, max_points_per_voxel=points_per_voxel),
            registration=parts.RegistrationConfig(
                max_num_iterations=iterations_max,
                convergence_criterion=1e-4,
                max_num_threads=1,  # more would add up in another order
            ),
            adaptive_threshold=parts.AdaptiveThresholdConfig(
                fixed_threshold=None,
                initial_threshold=initial_threshold_m,
                min_motion_th=motion_min_m,
            ),
        )
        self._odometry: Any = KissICP(config)
        self._voxel_m, self._range_max_m = voxel_m, range_max_m
        self._known = np.zeros(_SLOTS, np.bool_)
        self._marked_at = np.zeros(3)

    def register(self, cloud: Cloud, T_local_guess: se3.Transform) -> se3.Transform:
        """Return T_local_base of a cloud (N, 3) in base."""
        self._source, self._dense = self._odometry.voxelize(cloud)
        sigma_m = self._odometry.adaptive_threshold.get_threshold()
        T_local_base = self._odometry.registration.align_points_to_map(
            points=self._source,
            voxel_map=self._odometry.local_map,
            initial_guess=T_local_guess,
            max_correspondance_distance=3.0 * sigma_m,
            kernel=sigma_m,
        )
        return np.array(T_local_base, dtype=np.float64)

    def overlap(self, T_local_base: se3.Transform) -> tuple[float, int]:
        """Return the share and the number of points whose voxel the map knows."""
        inliers = int(self._known[self._slots(se3.apply(T_local_base, self._source))].sum())
        return inliers / max(len(self._source), 1), inliers

    def localizability(self) -> Localizability:
        """Return how well the last cloud's shape holds the pose, in base."""
        thinned = self._dense[:: max(1, round(len(self._dense) / _SHAPE_POINTS))]
        return cloud_localizability(thinned, 2.0 * self._voxel_m)

    def accept(self, T_local_guess: se3.Transform, T_local_base: se3.Transform) -> None:
        """Add the last cloud to the map, and learn how good guesses are."""
        deviation = se3.inverse(T_local_guess) @ T_local_base
        self._odometry.adaptive_threshold.update_model_deviation(deviation)
        self._odometry.local_map.update(self._dense, T_local_base)
        if np.linalg.norm(T_local_base[:3, 3] - self._marked_at) > 0.5 * self._range_max_m:
            self._known[:] = False  # the library forgets what is out of range
            self._known[self._slots(self.points())] = True
            self._marked_at = T_local_base[:3, 3]
        self._known[self._slots(se3.apply(T_local_base, self._dense))] = True

    def points(self) -> NDArray[np.float64]:
        """Return the map's points (N, 3) [m], local."""
        return np.asarray(self._odometry.local_map.point_cloud()).reshape(-1, 3)

    def _slots(self, points: NDArray[Any]) -> NDArray[np.int64]:
        """Return each point's place in the table of known voxels; few share one."""
        cells = np.floor(points / self._voxel_m).astype(np.int64)
        keys = (cells[:, 0] * 73856093) ^ (cells[:, 1] * 19349669) ^ (cells[:, 2] * 83492791)
        return np.asarray(keys & (_SLOTS - 1))
