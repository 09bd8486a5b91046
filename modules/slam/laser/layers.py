"""What the module hands to the atlas: scans at their poses, and covariances."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.scans.occupancy_grid import scan_layer
from sceneslam.types.maps import MapLayers
from sceneslam.types.planar import Matrix, spatial_covariance, to_transform
from sceneslam.types.se3 import Transform

from .keyframes import ScanKeyframes

_LEVEL_DEVIATION = 0.01  # m and rad: standard deviation of z, roll and pitch on a floor


def map_layers(
    keyframes: ScanKeyframes, T_base_laser: Transform, *, cell_m: float, range_max_m: float
) -> MapLayers:
    """Return the scans of the keyframes, in `local`."""
    frames = keyframes.frames
    scans = scan_layer(
        [frame.scan for frame in frames],
        [to_transform(frame.T_local_base) @ T_base_laser for frame in frames],
        cell_m=cell_m,
        range_max_m=range_max_m,
    )
    return MapLayers(scans=scans)


def covariance_6(covariance: Matrix) -> NDArray[np.float64]:
    """Return the (6, 6) covariance of se3.log from that of (x, y, yaw), same axes."""
    return spatial_covariance(covariance, level=_LEVEL_DEVIATION**2)
