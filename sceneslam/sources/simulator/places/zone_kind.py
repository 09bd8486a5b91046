"""The description of a zone of the building: a box with two doors, its route and light."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from sceneslam.sources.simulator.places.pictures import decorated
from sceneslam.sources.simulator.places.place import SUN, Lamp, PanelBuilder
from sceneslam.sources.simulator.places.surfaces import OAK, WALNUT, Material, wood

WALL_M = 0.12  # between two zones
DOOR_WIDTH_M, DOOR_TOP_M = 0.95, 2.05

Point = tuple[float, float]
# Each picture on a wall: left, top, width, height [m] and its material.
Pictures = tuple[tuple[float, float, float, float, Material], ...]
Doors = tuple[float, ...]  # y along their wall, in the zone's frame


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneKind:
    """A zone in its own frame; it is entered at (0, 0) along +x.

    It is left at `exit_xy_m`: through its east wall along +x, or through its west wall along -x.
    """

    name: str
    size_m: tuple[float, float, float]  # along x, from south to north, height
    south_m: float  # y of its south wall
    exit_xy_m: Point
    route: tuple[Point, ...]  # way points between the doors
    furnish: Callable[[PanelBuilder, int], None]  # adds furniture; twins have the same seed
    floor: Material
    wall: Material
    ceiling: Material | None  # None: open to the sky
    pictures: Mapping[str, Pictures] = field(
        default_factory=dict
    )  # of the walls south, north, west, east: left, top, width, height [m], material
    windows: Mapping[str, tuple[float, float, float, float]] = field(default_factory=dict)
    lamps: tuple[tuple[float, float, float, float], ...] = ()  # x, y, width, depth [m]
    power: float = 0.0  # of each lamp
    is_lit: bool = True
    has_polished_floor: bool = False
    slippery: tuple[tuple[Point, Point, float], ...] = ()  # x and y of a rectangle, slip ratio
    heights: tuple[Point, ...] = ()  # of the floor: (x, height) knots
    walks: tuple[tuple[Point, Point], ...] = ()  # of people, start and end

    @property
    def group(self) -> str:
        """Return the zone's lamp group: its name, or the sun."""
        return self.name if self.ceiling else SUN

    def build(self, builder: PanelBuilder, twin_seed: int) -> None:
        """Add the zone's panels in its own frame."""
        builder.is_polished = self.has_polished_floor
        self._floor(builder)
        builder.is_polished = False
        length_m, width_m, height_m = self.size_m
        y_m = (self.south_m, self.south_m + width_m)
        if self.ceiling:
            builder.level((0, length_m), y_m, height_m, self.ceiling, faces_up=False)
        self._wall(builder, "south", ((length_m, y_m[0]), (0, y_m[0])))
        self._wall(builder, "north", ((0, y_m[1]), (length_m, y_m[1])))
        has_two_west = self.exit_xy_m[0] == 0
        west = (0.0, self.exit_xy_m[1]) if has_two_west else (0.0,)
        self._wall_with_doors(builder, "west", 0.0, west)
        self._wall_with_doors(builder, "east", length_m, () if has_two_west else (0.0,))
        self.furnish(builder, twin_seed)

    def lamps_at(self, builder: PanelBuilder) -> list[Lamp]:
        """Return the zone's lamps in gt."""
        height_m = self.size_m[2] - 0.01
        turn = builder.T_gt_local
        return [
            Lamp(
                group=self.group,
                centre_m=_moved(turn, (x_m, y_m, height_m)),
                size_xy_m=(wide_m, deep_m),
                power=self.power,
                points_per_side=2,
                reach_m=14.0,
            )
            for x_m, y_m, wide_m, deep_m in self.lamps
        ]

    def _floor(self, builder: PanelBuilder) -> None:
        length_m, width_m, _ = self.size_m
        knots = [(0.0, 0.0), *self.heights, (length_m, 0.0)]
        for (x0, z0), (x1, z1) in pairwise(knots):
            if x1 - x0 > 1e-9:
                corner = np.array([x0, self.south_m + width_m, z0])
                across, down = np.array([x1 - x0, 0, z1 - z0]), np.array([0, -width_m, 0])
                builder.panel(corner, across, down, self.floor)

    def _wall(self, builder: PanelBuilder, side: str, ends: tuple[Point, Point]) -> None:
        look = decorated(self.wall, *self.pictures.get(side, ()))
        height_m = (0.0, self.size_m[2])
        builder.wall(*ends, height_m, look, hole_m=self.windows.get(side))

    def _wall_with_doors(self, builder: PanelBuilder, side: str, x_m: float, doors: Doors) -> None:
        """Add a wall across the zone, one piece per door."""
        south, north = self.south_m, self.south_m + self.size_m[1]
        edges = [south, *np.add(doors[:-1], doors[1:]) / 2, north]
        for piece, (low, high) in enumerate(pairwise(edges)):
            hole = None
            if doors:
                along = doors[piece] - low if side == "west" else high - doors[piece]
                top_m = self.size_m[2] - DOOR_TOP_M
                hole = (along - DOOR_WIDTH_M / 2, top_m, DOOR_WIDTH_M, DOOR_TOP_M)
            shown = self.pictures.get(side, ()) if piece == 0 else ()
            look = decorated(self.wall, *shown, *(_frame(hole) if hole else ()))
            ends = ((x_m, low), (x_m, high)) if side == "west" else ((x_m, high), (x_m, low))
            builder.wall(*ends, (0.0, self.size_m[2]), look, hole_m=hole)


def line_door(builder: PanelBuilder, x_m: tuple[float, float], y_m: float) -> None:
    """Add the wooden lining of a door."""
    (x0, x1), y0, y1 = x_m, y_m - DOOR_WIDTH_M / 2, y_m + DOOR_WIDTH_M / 2
    builder.wall((x1, y0), (x0, y0), (0, DOOR_TOP_M), wood(OAK))
    builder.wall((x0, y1), (x1, y1), (0, DOOR_TOP_M), wood(OAK))
    builder.level(x_m, (y0, y1), DOOR_TOP_M, wood(OAK), faces_up=False)
    builder.level(x_m, (y0, y1), 0.0, wood(WALNUT))


def _frame(
    hole_m: tuple[float, float, float, float],
) -> list[tuple[float, float, float, float, Material]]:
    """Return the strips of a door frame."""
    left, top, wide, high = hole_m
    return [
        (left - 0.07, top - 0.07, 0.07, high + 0.07, wood(OAK)),
        (left + wide, top - 0.07, 0.07, high + 0.07, wood(OAK)),
        (left, top - 0.07, wide, 0.07, wood(OAK)),
    ]


def _moved(
    T_gt_local: np.ndarray, point_m: tuple[float, float, float]
) -> tuple[float, float, float]:
    x, y, z = T_gt_local[:3, :3] @ np.array(point_m) + T_gt_local[:3, 3]
    return float(x), float(y), float(z)
