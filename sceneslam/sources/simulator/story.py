"""A story: place, route and light over time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from sceneslam.sources.simulator.places.place import NIGHT, SUN
from sceneslam.sources.simulator.robot.motion import Move

Knots = tuple[tuple[float, float], ...]  # (time [s], level 0..1), linear between

OFF: Knots = ((0.0, 0.0),)


@dataclass(frozen=True, slots=True, kw_only=True)
class Story:
    """One drive. Lamps that are not listed are at full power."""

    about: str
    place: str = "two_rooms"  # or sunny_rooms, bare_rooms, corridor, building
    start_x_y_deg: tuple[float, float, float] = (3.0, 2.9, -150.0)
    moves: tuple[Move, ...]
    lamps: Mapping[str, Knots] = field(default_factory=lambda: {"b": OFF})

    def levels(self, groups: Iterable[str], time_s: float, lights: str) -> dict[str, float]:
        """Return the level of each lamp group; `lights` (on, off) overrides all switched ones."""
        levels = {group: 0.0 if group == SUN else 1.0 for group in groups}
        for group, knots in self.lamps.items():
            times, values = zip(*knots, strict=True)
            levels[group] = float(np.interp(time_s, times, values))
        if lights != "story":
            switched = levels.keys() - {NIGHT, SUN}
            levels |= dict.fromkeys(switched, 1.0 if lights == "on" else 0.0)
        return levels
