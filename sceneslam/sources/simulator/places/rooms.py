"""The places of the short stories: two furnished rooms, or a room and a bare corridor.

In frame gt, room A spans x 0..5, y 0..4.2; the wall to the next room x 5..5.12; z is up.
"""

from __future__ import annotations

import numpy as np

from sceneslam.sources.simulator.places.floor import BuildingLayout, Door, Zone
from sceneslam.sources.simulator.places.furniture import (
    Spot,
    bed,
    bookshelf,
    cabinet,
    chair,
    door_leaf,
    parcels,
    plant,
    sideboard,
    sofa,
    table,
    wall_shelf,
)
from sceneslam.sources.simulator.places.pictures import decorated, painting, pin_board, poster
from sceneslam.sources.simulator.places.place import NIGHT, Lamp, PanelBuilder, SimulatedPlace, Sun
from sceneslam.sources.simulator.places.surfaces import (
    BIRCH,
    OAK,
    WALNUT,
    WHITE,
    Colour,
    Material,
    carpet_tiles,
    fabric,
    floorboards,
    paint,
    rug,
    slats,
    wood,
)

HEIGHT_M = 2.5
DOOR_TOP_M = 2.05
DOOR_Y_M = (1.5, 2.45)
_A_X_M, _A_Y_M = (0.0, 5.0), (0.0, 4.2)
_B_X_M, _B_Y_M = (5.12, 10.2), (0.0, 4.2)
_CORRIDOR_X_M, _CORRIDOR_Y_M = (5.12, 19.5), (1.15, 2.8)
_WINDOW_X_M, _WINDOW_Z_M = (1.3, 2.9), (0.95, 2.1)
_BLUE_GREY: Colour = (162, 150, 138)
_POWER_A, _POWER_B, _POWER_CORRIDOR = 5.4, 13.0, 2.0
_NIGHT_POWER = 0.03  # stand-by lights and street lamps: never completely dark
_SUN = Sun(direction=(0.42, -0.62, -0.66), power=4.4, sky=3.0)


def floor_plan() -> BuildingLayout:
    """Return the layout: room A and the zone behind its door; the border is the wall's middle."""
    border_m = (_A_X_M[1] + _B_X_M[0]) / 2
    room_a = Zone(name="a", x_m=(_A_X_M[0], border_m), y_m=_A_Y_M, group="a")
    behind = Zone(name="b", x_m=(border_m, _CORRIDOR_X_M[1]), y_m=_B_Y_M, group="b")
    return BuildingLayout(zones=(room_a, behind), doors=(Door(x_m=border_m, y_m=DOOR_Y_M),))


def two_rooms(
    rng: np.random.Generator, *, sunny: bool = False, bare: bool = False
) -> SimulatedPlace:
    """Return rooms A and B.

    `sunny`: sunlight enters by the window of A. `bare`: the south wall of A has no furniture.
    """
    builder = PanelBuilder(rng)
    _room_a(builder, sunny=sunny, bare=bare)
    _room_b(builder)
    lamps = [*_lamps_a(), _night((2.6, 3.0)), _night((7.9, 3.4))]
    lamps += [_lamp("b", (x_m, 2.1), (0.6, 0.6), _POWER_B) for x_m in (6.5, 8.9)]
    return SimulatedPlace(
        panels=tuple(builder.panels), lamps=tuple(lamps), sun=_SUN if sunny else None
    )


def corridor(rng: np.random.Generator) -> SimulatedPlace:
    """Return room A and, behind its door, a bare corridor 14 m long."""
    builder = PanelBuilder(rng)
    _room_a(builder)
    (x0, x1), (y0, y1) = _CORRIDOR_X_M, _CORRIDOR_Y_M
    wall = paint((166, 174, 178))
    builder.level((x0, x1), (y0, y1), 0.0, carpet_tiles)
    builder.level((x0, x1), (y0, y1), HEIGHT_M, wall, faces_up=False)
    builder.wall((x0, y1), (x1, y1), (0, HEIGHT_M), wall)
    builder.wall((x1, y0), (x0, y0), (0, HEIGHT_M), wall)
    builder.wall((x1, y1), (x1, y0), (0, HEIGHT_M), wall)
    _wall_with_door(builder, x0, (y0, y1), wall, faces_east=True)
    lamps = [*_lamps_a(), _night((2.6, 3.0)), _night((9.0, 2.0)), _night((15.0, 2.0))]
    lamps += [
        _lamp("b", (float(at), 1.98), (0.9, 0.25), _POWER_CORRIDOR)
        for at in np.arange(6.6, x1, 2.4)
    ]
    return SimulatedPlace(panels=tuple(builder.panels), lamps=tuple(lamps))


def _room_a(builder: PanelBuilder, *, sunny: bool = False, bare: bool = False) -> None:
    """Build the living room."""
    white = paint(WHITE)
    (x0, x1), (y0, y1) = _A_X_M, _A_Y_M
    carpet = decorated(floorboards(OAK), (0.75, 1.35, 2.2, 1.5, rug))
    builder.level((x0, x1), (y0, y1), 0.0, carpet)
    builder.level((x0, x1), (y0, y1), HEIGHT_M, white, faces_up=False)
    south = decorated(white, (1.05, 0.75, 0.9, 0.7, painting), (2.15, 0.8, 0.55, 0.8, poster))
    builder.wall((x1, y0), (x0, y0), (0, HEIGHT_M), white if bare else south)
    west = decorated(white, (1.9, 0.7, 0.8, 0.6, painting), (2.85, 0.85, 0.5, 0.7, poster))
    builder.wall((x0, y0), (x0, y1), (0, HEIGHT_M), west)
    _wall_with_window(builder, y1, sunny=sunny)
    pieces = ((0.35, 0.8, 0.9, 0.7, painting), (2.95, 0.75, 0.75, 0.85, pin_board))
    _wall_with_door(builder, x1, (y0, y1), decorated(white, *pieces), faces_east=False)
    bookshelf(builder, Spot(0.17, 0.95, 90), (1.3, 1.9), BIRCH)
    plant(builder, Spot(0.4, 3.75), 1.2)
    sofa(builder, Spot(2.0, 3.72), 1.9, (128, 158, 172))
    table(builder, Spot(1.75, 2.45, 4), (0.9, 0.5, 0.42), wood(OAK, 1.6))
    table(builder, Spot(1.2, 0.95, -5), (0.8, 0.7, 0.74), wood(BIRCH, 1.5))
    chair(builder, Spot(1.75, 1.2, -80), wood(OAK), fabric((52, 50, 128)))
    chair(builder, Spot(1.15, 1.62, 12), wood(OAK), fabric((110, 70, 40)))
    cabinet(builder, Spot(4.74, 0.45, -90), (0.75, 0.42, 0.92), wood(BIRCH, 1.4))
    parcels(builder, Spot(4.55, 3.9, 8))
    if not bare:
        sideboard(builder, Spot(3.2, 0.19, 180), 1.5)
        plant(builder, Spot(2.2, 0.3), 0.9)
    door_leaf(builder, Spot(4.54, 1.47, 180))


def _room_b(builder: PanelBuilder) -> None:
    """Build the bedroom, in darker colours."""
    wall = paint(_BLUE_GREY)
    (x0, x1), (y0, y1) = _B_X_M, _B_Y_M
    builder.level((x0, x1), (y0, y1), 0.0, floorboards((64, 92, 122)))
    builder.level((x0, x1), (y0, y1), HEIGHT_M, paint(WHITE), faces_up=False)
    south = decorated(wall, (2.9, 0.8, 0.9, 0.7, painting), (4.0, 0.8, 0.55, 0.8, poster))
    builder.wall((x1, y0), (x0, y0), (0, HEIGHT_M), south)
    north = decorated(wall, (0.4, 0.8, 0.8, 0.8, pin_board), (3.6, 0.9, 0.7, 0.55, painting))
    builder.wall((x0, y1), (x1, y1), (0, HEIGHT_M), north)
    east = decorated(wall, (1.2, 0.8, 1.0, 0.75, painting), (2.6, 0.7, 0.55, 0.8, poster))
    builder.wall((x1, y1), (x1, y0), (0, HEIGHT_M), east)
    pieces = ((0.25, 0.8, 0.55, 0.8, poster), (2.9, 0.8, 0.8, 0.6, painting))
    _wall_with_door(builder, x0, (y0, y1), decorated(wall, *pieces), faces_east=True)
    bed(builder, Spot(9.6, 3.1))
    bookshelf(builder, Spot(8.0, 4.02), (1.2, 1.75), WALNUT)
    cabinet(builder, Spot(6.6, 3.95), (0.8, 0.42, 0.75), wood(OAK, 1.5))
    table(builder, Spot(9.75, 1.0, -90), (1.2, 0.6, 0.74), wood(OAK, 1.5))
    chair(builder, Spot(9.2, 0.95, 100), wood(WALNUT), fabric((90, 60, 60)))
    parcels(builder, Spot(6.3, 0.35, 172))
    cabinet(builder, Spot(8.1, 0.25, 180), (0.9, 0.4, 0.8), wood(WALNUT, 1.4))
    plant(builder, Spot(5.5, 3.85), 1.1)
    parcels(builder, Spot(6.85, 2.72, 30))
    table(builder, Spot(6.9, 1.1, 12), (0.6, 0.45, 0.45), wood(WALNUT, 1.4))
    wall_shelf(builder, Spot(5.2, 3.4, 90), 0.55)


def _wall_with_door(
    builder: PanelBuilder, x_m: float, y_m: tuple[float, float], look: Material, *, faces_east: bool
) -> None:
    """Build one side of the wall at x with its door frame; the west side adds the door's lining."""
    (south, north), (y0, y1) = y_m, DOOR_Y_M
    left_m = y0 - south if faces_east else north - y1
    wide_m, top_m = y1 - y0, HEIGHT_M - DOOR_TOP_M
    framed = decorated(
        look,
        (left_m - 0.07, top_m - 0.07, 0.07, DOOR_TOP_M + 0.07, wood(OAK)),
        (left_m + wide_m, top_m - 0.07, 0.07, DOOR_TOP_M + 0.07, wood(OAK)),
        (left_m, top_m - 0.07, wide_m, 0.07, wood(OAK)),
    )
    ends = ((x_m, south), (x_m, north)) if faces_east else ((x_m, north), (x_m, south))
    builder.wall(*ends, (0, HEIGHT_M), framed, hole_m=(left_m, top_m, wide_m, DOOR_TOP_M))
    if not faces_east:
        _line_hole(builder, (x_m, _B_X_M[0]), DOOR_Y_M)


def _line_hole(builder: PanelBuilder, x_m: tuple[float, float], y_m: tuple[float, float]) -> None:
    """Add the wooden lining of the door."""
    (x0, x1), (y0, y1) = x_m, y_m
    builder.wall((x1, y0), (x0, y0), (0, DOOR_TOP_M), wood(OAK))
    builder.wall((x0, y1), (x1, y1), (0, DOOR_TOP_M), wood(OAK))
    builder.level(x_m, y_m, DOOR_TOP_M, wood(OAK), faces_up=False)
    builder.level(x_m, y_m, 0.0, wood(WALNUT))


def _wall_with_window(builder: PanelBuilder, y_m: float, *, sunny: bool) -> None:
    """Build the north wall of A: its window has a lowered blind, or lets the sun in."""
    (left, right), (sill, top) = _WINDOW_X_M, _WINDOW_Z_M
    white, wide = paint(WHITE), right - left
    window = (left, HEIGHT_M - top, wide, top - sill)
    rest = decorated(white, (3.35, 0.75, 0.9, 0.7, painting), (0.45, 0.7, 0.6, 0.8, poster))
    x0, x1 = _A_X_M
    if not sunny:
        look = decorated(rest, (*window, slats((188, 200, 206))))
        builder.wall((x0, y_m), (x1, y_m), (0, HEIGHT_M), look)
        return
    builder.wall((x0, y_m), (x1, y_m), (0, HEIGHT_M), rest, hole_m=window)
    outside = y_m + 0.15
    builder.wall((left, y_m), (left, outside), (sill, top), white)
    builder.wall((right, outside), (right, y_m), (sill, top), white)
    builder.level(_WINDOW_X_M, (y_m, outside), sill, white)
    builder.level(_WINDOW_X_M, (y_m, outside), top, white, faces_up=False)


def _lamp(
    group: str, at_xy_m: tuple[float, float], size_xy_m: tuple[float, float], power: float
) -> Lamp:
    centre_m = (*at_xy_m, HEIGHT_M - 0.01)
    return Lamp(group=group, centre_m=centre_m, size_xy_m=size_xy_m, power=power)


def _lamps_a() -> list[Lamp]:
    return [_lamp("a", at, (0.6, 0.6), _POWER_A) for at in ((1.4, 2.2), (3.5, 1.4))]


def _night(at_xy_m: tuple[float, float]) -> Lamp:
    centre_m = (*at_xy_m, HEIGHT_M - 0.2)
    return Lamp(group=NIGHT, centre_m=centre_m, size_xy_m=(0.4, 0.4), power=_NIGHT_POWER)
