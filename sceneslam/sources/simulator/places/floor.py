"""The layout of a place: zones, doors, height of the floor, and slippery areas."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_NEAR_M = 0.5  # more than the distance between a robot's wheels

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Profile:
    """Heights along x, constant within a range of y: a ramp or a sill."""

    x_m: tuple[float, ...]  # rising, frame gt
    height_m: tuple[float, ...]  # at each x; linear between, 0 outside
    y_m: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Slippery:
    """A rectangle on which wheels slip: foil, water, or polished stone."""

    x_m: tuple[float, float]  # frame gt
    y_m: tuple[float, float]
    slip_ratio: float  # share of the wheels' rotation that is lost, 0 to below 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Floor:
    """A floor that is level and dry, except for its profiles and slippery areas."""

    profiles: tuple[Profile, ...] = ()
    slippery: tuple[Slippery, ...] = ()

    def is_raised_near(self, x_m: float, y_m: float) -> bool:
        """Tell whether a profile is at or near a point."""
        return any(
            one.x_m[0] - _NEAR_M <= x_m <= one.x_m[-1] + _NEAR_M
            and one.y_m[0] - _NEAR_M <= y_m <= one.y_m[1] + _NEAR_M
            for one in self.profiles
        )

    def height_m(self, x_m: Values, y_m: Values) -> Values:
        """Return the height (N,) [m] of the floor at points of x and y (N,) [m], gt."""
        total = np.zeros(np.shape(x_m))
        for one in self.profiles:
            height = np.interp(x_m, one.x_m, one.height_m, left=0.0, right=0.0)
            total += np.where((y_m >= one.y_m[0]) & (y_m < one.y_m[1]), height, 0.0)
        return total

    def slip_ratio(self, x_m: Values, y_m: Values) -> Values:
        """Return the slip ratio (N,) at points of x and y (N,) [m], gt."""
        worst = np.zeros(np.shape(x_m))
        for one in self.slippery:
            inside = (x_m >= one.x_m[0]) & (x_m < one.x_m[1])
            inside &= (y_m >= one.y_m[0]) & (y_m < one.y_m[1])
            worst = np.maximum(worst, np.where(inside, one.slip_ratio, 0.0))
        return worst


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """A rectangle with one lamp group, whose state determines the true scene."""

    name: str
    x_m: tuple[float, float]  # frame gt, from west to east
    y_m: tuple[float, float]
    group: str  # lamp group, or the sun

    def holds(self, x_m: float, y_m: float) -> bool:
        """Tell whether a point lies in the zone."""
        return self.x_m[0] <= x_m < self.x_m[1] and self.y_m[0] <= y_m < self.y_m[1]


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """An opening between two zones, in a wall of constant x."""

    x_m: float  # frame gt, the middle of the wall
    y_m: tuple[float, float]

    def is_passed(self, start_m: Values, end_m: Values) -> bool:
        """Tell whether the line between two points (2,) [m], gt, passes the door."""
        before_m, after_m = start_m[0] - self.x_m, end_m[0] - self.x_m
        if before_m * after_m >= 0.0:
            return False
        y_m = start_m[1] + (end_m[1] - start_m[1]) * before_m / (before_m - after_m)
        return bool(self.y_m[0] <= y_m <= self.y_m[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildingLayout:
    """Zones, doors and floor: what the robot's path and the true scenes depend on."""

    zones: tuple[Zone, ...]
    doors: tuple[Door, ...]
    floor: Floor = field(default_factory=Floor)
