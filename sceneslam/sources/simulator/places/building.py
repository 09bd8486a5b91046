"""A building: two rows of zones, connected by two long corridors to a ring.

Frame gt: the office's west door is the origin; the first row runs east along y = 0, the second one
back west along y = 20. For any order of the zones, a lobby makes the shorter row as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneslam.sources.simulator.places import zones
from sceneslam.sources.simulator.places.floor import (
    BuildingLayout,
    Door,
    Floor,
    Profile,
    Slippery,
    Zone,
)
from sceneslam.sources.simulator.places.place import NIGHT, Lamp, PanelBuilder, SimulatedPlace, Sun
from sceneslam.sources.simulator.places.walker import Walker
from sceneslam.sources.simulator.places.zone_kind import DOOR_WIDTH_M, WALL_M, ZoneKind, line_door
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

START_XY_M = (2.0, 0.0)  # in the office
_IN_FIRST_ROW = 3
_LOBBY_M = 4.0  # shortest length
_NIGHT_POWER = 0.002  # exit signs: only noise at the camera's longest exposure
_CELL_M = 0.12
_ON_PEOPLE = 0.5  # irradiance on people, as on the lit walls
_SUN_POWER, _SKY = 8.0, 6.0
_BLINDING = 0.03 * _SUN_POWER  # about 3000 of the sun's 100,000 lux

Point = tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlacedZone:
    """A zone with its pose in `gt`."""

    kind: ZoneKind
    T_gt_local: Transform

    def gt(self, point_m: Point) -> Point:
        """Return a point (x, y) [m] of the zone's frame in `gt`."""
        x, y, _, _ = self.T_gt_local @ [*point_m, 0.0, 1.0]
        return float(x), float(y)

    def box(self, x_m: Point, y_m: Point) -> tuple[Point, Point]:
        """Return a rectangle of the zone's frame in `gt`: its ranges of x and y [m]."""
        (ax, ay), (bx, by) = self.gt((x_m[0], y_m[0])), self.gt((x_m[1], y_m[1]))
        return (min(ax, bx), max(ax, bx)), (min(ay, by), max(ay, by))


def layout(order_seed: int | None) -> tuple[PlacedZone, ...]:
    """Return the zones along the ring from the office on; a seed shuffles all but corridors."""
    twins = (zones.twin("twin_a"), zones.twin("twin_b"))
    drawn = (*twins, zones.hall(), zones.atrium(), zones.ramp(), zones.store())
    order = np.arange(len(drawn))
    if order_seed is not None:
        np.random.default_rng(order_seed).shuffle(order)
    there = [zones.office(), *(drawn[index] for index in order[:_IN_FIRST_ROW])]
    back = [drawn[index] for index in order[_IN_FIRST_ROW:]]
    longer_m = _length_m(there) - _length_m(back)
    there.append(zones.lobby("lobby_east", _LOBBY_M + max(0.0, -longer_m)))
    back.append(zones.lobby("lobby_west", _LOBBY_M + max(0.0, longer_m)))
    ring = (*there, zones.poster_corridor(), *back, zones.bare_corridor())
    placed, x_m = [], 0.0
    for index, kind in enumerate(ring):
        is_back = index > len(there)
        placed.append(PlacedZone(kind=kind, T_gt_local=_stand(x_m, is_back=is_back)))
        if kind.exit_xy_m[0] > 0:
            x_m += (-1 if is_back else 1) * (kind.exit_xy_m[0] + WALL_M)
        else:
            x_m -= WALL_M
    return tuple(placed)


def build(rng: np.random.Generator, order_seed: int | None) -> SimulatedPlace:
    """Return the building."""
    builder, placed = PanelBuilder(rng), layout(order_seed)
    twin_seed = int(rng.integers(2**32))
    lamps: list[Lamp] = []
    for one in placed:
        builder.T_gt_local = one.T_gt_local
        one.kind.build(builder, twin_seed)
        lamps += one.kind.lamps_at(builder)
        exit_x, exit_y = one.kind.exit_xy_m
        line_door(builder, (exit_x, exit_x + WALL_M) if exit_x > 0 else (-WALL_M, 0.0), exit_y)
    builder.T_gt_local = se3.identity()
    lamps += [_night(one) for one in placed]
    outside = next(one for one in placed if one.kind.ceiling is None).T_gt_local[1, 1]
    sun = Sun(
        direction=(0.35, 0.62 * float(outside), -0.66),
        power=_SUN_POWER,
        sky=_SKY,
        blinding=_BLINDING,
    )
    return SimulatedPlace(
        panels=tuple(builder.panels),
        lamps=tuple(lamps),
        sun=sun,
        people=tuple(person for one in placed for person in _people(one)),
        cell_m=_CELL_M,
    )


def floor_plan(order_seed: int | None) -> BuildingLayout:
    """Return the building's layout: zones, doors and floor."""
    placed = layout(order_seed)
    return BuildingLayout(
        zones=tuple(_zone(one) for one in placed),
        doors=tuple(_door(one) for one in placed),
        floor=_floor(placed),
    )


def dark_groups() -> tuple[str, ...]:
    """Return the lamp groups that are off."""
    return tuple(one.kind.group for one in layout(None) if not one.kind.is_lit)


def tour(order_seed: int | None) -> tuple[Point, ...]:
    """Return the route (x, y) [m], gt: around the ring, into the first zone again, and back."""
    placed = layout(order_seed)
    start, around = placed[0], [one.gt(point) for one in placed for point in one.kind.route]
    again = [one.gt(point) for one in placed[:3] for point in one.kind.route]
    home = [placed[1].gt((0.0, 0.0)), start.gt((5.0, 0.0)), start.gt(START_XY_M)]
    return (*around[1:], *again, *home)


def _length_m(row: list[ZoneKind]) -> float:
    return sum(kind.size_m[0] for kind in row) + WALL_M * (len(row) - 1)


def _stand(x_m: float, *, is_back: bool) -> Transform:
    T_gt_local = se3.identity()
    T_gt_local[0, 3] = x_m
    if is_back:
        T_gt_local[0, 0] = T_gt_local[1, 1] = -1.0
        T_gt_local[1, 3] = zones.ROWS_APART_M
    return T_gt_local


def _zone(one: PlacedZone) -> Zone:
    """Return a zone's rectangle; its border is the middle of the walls."""
    length_m, width_m, _ = one.kind.size_m
    half = WALL_M / 2
    x_m, y_m = one.box((-half, length_m + half), (one.kind.south_m, one.kind.south_m + width_m))
    return Zone(name=one.kind.name, x_m=x_m, y_m=y_m, group=one.kind.group)


def _door(one: PlacedZone) -> Door:
    """Return the exit door of a zone."""
    exit_x, exit_y = one.kind.exit_xy_m
    x_m, y_m = one.gt((exit_x + (WALL_M if exit_x > 0 else -WALL_M) / 2, exit_y))
    return Door(x_m=x_m, y_m=(y_m - DOOR_WIDTH_M / 2, y_m + DOOR_WIDTH_M / 2))


def _night(one: PlacedZone) -> Lamp:
    x_m, y_m = one.gt((one.kind.size_m[0] / 2, one.kind.south_m + one.kind.size_m[1] / 2))
    return Lamp(
        group=NIGHT,
        centre_m=(x_m, y_m, one.kind.size_m[2] - 0.2),
        size_xy_m=(0.4, 0.4),
        power=_NIGHT_POWER,
        points_per_side=2,
        reach_m=14.0,
    )


def _people(one: PlacedZone) -> Iterator[Walker]:
    for start_m, end_m in one.kind.walks:
        yield Walker(
            start_m=one.gt(start_m), end_m=one.gt(end_m), group=one.kind.group, light=_ON_PEOPLE
        )


def _floor(placed: tuple[PlacedZone, ...]) -> Floor:
    profiles, slippery = [], []
    for one in placed:
        for x_m, y_m, ratio in one.kind.slippery:
            x_gt, y_gt = one.box(x_m, y_m)
            slippery.append(Slippery(x_m=x_gt, y_m=y_gt, slip_ratio=ratio))
        if one.kind.heights:
            south_m, north_m = one.kind.south_m, one.kind.south_m + one.kind.size_m[1]
            knots = sorted((one.gt((x, 0.0))[0], height) for x, height in one.kind.heights)
            _, y_gt = one.box((0.0, 0.0), (south_m, north_m))
            x_knots, heights = zip(*knots, strict=True)
            profiles.append(Profile(x_m=x_knots, height_m=heights, y_m=y_gt))
    return Floor(profiles=tuple(profiles), slippery=tuple(slippery))
