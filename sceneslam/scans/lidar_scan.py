"""Conversion of lidar clouds to planar laser scans at the lidar's height.

The scan's frame `laser` is below (or above) the lidar in the plane z = 0 of `base`, with x along
the lidar's x: T_base_laser = (lidar x, lidar y, yaw of its x axis). Heights are above `base`, so
that a tilted lidar gives a horizontal scan.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.band import checked_band
from sceneslam.types import se3
from sceneslam.types.errors import InputError
from sceneslam.types.observation import LaserScan
from sceneslam.types.rig import Lidar


class LidarScanner:
    """Converts one lidar's clouds to scans: the nearest return per beam within a band."""

    def __init__(
        self,
        lidar: Lidar,
        *,
        height_min_m: float | None = None,
        height_max_m: float | None = None,
        beams: int,
    ) -> None:
        """Compute the frame of the scans.

        The band [height_min_m, height_max_m] is above base. None: 0.15 m below (above) the lidar.
        `beams` cover 360 degrees.
        """
        T_base_lidar = lidar.T_base_lidar
        height_m = float(T_base_lidar[2, 3])
        self.band_m = checked_band(
            height_m, height_min_m=height_min_m, height_max_m=height_max_m, beams=beams
        )
        x_m, y_m = T_base_lidar[:2, 3]
        self.T_base_laser = se3.from_xy_yaw(x_m, y_m, se3.yaw_rad(T_base_lidar))
        self._T_laser_lidar = se3.inverse(self.T_base_laser) @ T_base_lidar
        self._range_m, self._beams = lidar.range_m, beams

    def scan(self, points_lidar: NDArray[np.floating], *, stamp_ns: int) -> LaserScan:
        """Return the scan of a cloud (N, 3) [m], lidar, in `laser`.

        A beam without a return in the band is NaN: most of a lidar's beams have other directions.
        Raises InputError if the cloud has another shape.
        """
        if points_lidar.ndim != 2 or points_lidar.shape[1] != 3:
            raise InputError(f"points_lidar: expected (N, 3), got {points_lidar.shape}")
        x, y, z = se3.apply(self._T_laser_lidar, points_lidar).T
        away = np.hypot(x, y)
        nearest_m, farthest_m = self._range_m
        valid = (z >= self.band_m[0]) & (z <= self.band_m[1])
        valid &= (away > 0) & (away >= nearest_m) & (away <= farthest_m)  # false for NaN
        step_rad = 2 * np.pi / self._beams
        beam = np.floor((np.arctan2(y[valid], x[valid]) + np.pi) / step_rad).astype(np.int64)
        ranges = np.full(self._beams, np.inf, dtype=np.float32)
        np.minimum.at(ranges, np.minimum(beam, self._beams - 1), away[valid].astype(np.float32))
        ranges[np.isinf(ranges)] = np.nan
        ranges.flags.writeable = False
        return LaserScan(
            stamp_ns=stamp_ns,
            ranges_m=ranges,
            angle_min_rad=-np.pi + 0.5 * step_rad,
            angle_step_rad=step_rad,
            range_min_m=nearest_m,
            range_max_m=farthest_m,
        )
