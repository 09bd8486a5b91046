"""What an operator may ask of a run while it goes."""

from __future__ import annotations

from dataclasses import dataclass

from sceneslam.types.maps import HybridMap


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectScene:
    """Take a scene for the one around the robot, as in the authors' manual bus."""

    scene: str  # one of the detector's; "": as detected


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectModule:
    """Take the scene whose first module this is for the one around the robot."""

    module: str  # a key of slam; "": as detected


@dataclass(frozen=True, slots=True, kw_only=True)
class Pause:
    """Take no observation, or take them again."""

    is_paused: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SaveMap:
    """Write a map into the run's folder, under `maps/NAME`."""

    name: str
    hybrid: HybridMap


Command = SelectScene | SelectModule | Pause | SaveMap
