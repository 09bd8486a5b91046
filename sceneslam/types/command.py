"""What an operator may ask of a run while it goes."""

from __future__ import annotations

from dataclasses import dataclass

from sceneslam.types.maps import HybridMap


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectScene:
    """Select the scene around the robot, as in the paper's manual mode."""

    scene: str  # one of the detector's; "": as detected


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectModule:
    """Select the scene whose first module this is."""

    module: str  # a key of slam; "": as detected


@dataclass(frozen=True, slots=True, kw_only=True)
class Pause:
    """Pause or continue processing of observations."""

    is_paused: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SaveMap:
    """Write a map into the run's folder, under `maps/NAME`."""

    name: str
    hybrid: HybridMap


Command = SelectScene | SelectModule | Pause | SaveMap
