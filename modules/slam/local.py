"""What a SLAM module may leave out: its poses are in `local`, and never revised."""

from __future__ import annotations

from sceneslam.types.maps import MapLayers
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory


class LocalModule:
    """The methods of `SlamModule` that need not do anything."""

    def set_pose(self, T_map_local: Transform) -> None:
        """Do nothing: poses are reported in `local`."""

    def set_scene(self, scene: str) -> None:
        """Do nothing: the module is the same in every scene."""

    def get_trajectory(self) -> Trajectory:
        """Return no poses: none is revised."""
        return Trajectory.empty()

    def get_map(self) -> MapLayers:
        """Return no layers: there is no map."""
        return MapLayers()

    def shutdown(self) -> None:
        """Do nothing: there is nothing to release; the map stays readable."""
