"""What the module hands to the atlas: scans at their poses."""

from __future__ import annotations

from sceneslam.scans.occupancy_grid import scan_layer
from sceneslam.types.maps import MapLayers
from sceneslam.types.planar import to_transform
from sceneslam.types.se3 import Transform

from .keyframes import ScanKeyframes


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
