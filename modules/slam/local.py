"""What a SLAM module may leave out, or leave to a module that it wraps."""

from __future__ import annotations

from sceneslam.interfaces import PipelinedSlam, SlamModule, closes_own_loops
from sceneslam.types.maps import MapLayers
from sceneslam.types.rig import Sensor
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory


class LocalModule:
    """The methods of `SlamModule` that need not do anything.

    Poses are in `local`, and never revised.
    """

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


class WrappedModule(LocalModule):
    """Passes on everything of a wrapped system but its poses and sessions."""

    _system: SlamModule | PipelinedSlam

    @property
    def closes_loops(self) -> bool:
        """Tell whether the system closes loops itself."""
        return closes_own_loops(self._system)

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the system's required sensors."""
        return self._system.requires

    def set_scene(self, scene: str) -> None:
        """Pass the scene to the system."""
        self._system.set_scene(scene)

    def get_map(self) -> MapLayers:
        """Return the system's map."""
        return self._system.get_map()

    def shutdown(self) -> None:
        """Shut the system down."""
        self._system.shutdown()
