"""The building's zones: in each, another sensor fails for a realistic reason."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sceneslam.sources.simulator.places.furniture import (
    Spot,
    bookshelf,
    cabinet,
    chair,
    parcels,
    plant,
    sideboard,
    sofa,
    table,
)
from sceneslam.sources.simulator.places.pictures import painting, pin_board, poster
from sceneslam.sources.simulator.places.place import PanelBuilder
from sceneslam.sources.simulator.places.surfaces import (
    BIRCH,
    OAK,
    WALNUT,
    WHITE,
    Material,
    brick,
    carpet_tiles,
    fabric,
    floorboards,
    paint,
    plain,
    stone_tiles,
    wood,
)
from sceneslam.sources.simulator.places.zone_kind import Pictures, ZoneKind

# Wheels slip where the floor is wet or covered: about a metre each time. A
# dry floor, polished or not, causes a few per cent of slip (rolling resistance is a fiftieth of the
# weight, and the slip of rubber is that small below a third of its largest traction).
ROWS_APART_M = 20.0  # the two rows of zones, from door to door
_RAMP_DEG = 8.0
_RAMP_M = 4.0  # from the foot to the level landing
_CORRIDOR_M = 2.2  # wide

_HALL_ROUTE = (
    *((1.0, 0.0), (6.0, -0.5), (9.5, -2.2), (12.5, -0.6), (11.5, 1.9)),
    *((9.0, 2.1), (7.6, 0.6), (9.0, -0.5), (13.0, 0.3), (19.0, 0.0)),
)


def office() -> ZoneKind:
    """Return the furnished office, where the tour begins and every sensor works."""
    return ZoneKind(
        name="office",
        size_m=(8.0, 6.0, 2.6),
        south_m=-3.0,
        exit_xy_m=(8.0, 0.0),
        route=((1.0, 0.0), (3.0, -0.7), (5.0, 0.6), (6.8, 0.0)),
        furnish=_furnish_office,
        floor=carpet_tiles,
        wall=paint(WHITE),
        ceiling=plain(WHITE),
        pictures={
            "south": ((0.6, 0.7, 0.9, 0.8, painting), (3.2, 0.7, 1.2, 0.8, pin_board)),
            "north": ((1.0, 0.7, 0.7, 0.9, poster), (5.6, 0.7, 1.0, 0.7, painting)),
            "west": ((0.5, 0.8, 0.9, 0.7, painting), (4.6, 0.8, 0.6, 0.8, poster)),
            "east": ((0.6, 0.8, 0.9, 0.9, pin_board), (4.4, 0.8, 0.9, 0.7, painting)),
        },
        lamps=(
            (2.0, -1.4, 1.2, 0.3),
            (2.0, 1.4, 1.2, 0.3),
            (6, -1.4, 1.2, 0.3),
            (6, 1.4, 1.2, 0.3),
        ),
        power=5.2,
        walks=(((5.8, 1.2), (6.9, 2.1)),),
    )


def twin(name: str) -> ZoneKind:
    """Return one of two rooms that look alike, but for the objects on the table."""
    return ZoneKind(
        name=name,
        size_m=(5.0, 4.4, 2.5),
        south_m=-2.2,
        exit_xy_m=(5.0, 0.0),
        route=((0.8, 0.0), (1.9, 0.45), (3.3, -0.3), (4.3, 0.0)),
        furnish=_furnish_twin,
        floor=floorboards(OAK),
        wall=paint((188, 200, 196)),
        ceiling=plain(WHITE),
        lamps=((1.4, 0.0, 0.6, 0.6), (3.6, 0.0, 0.6, 0.6)),
        power=4.0,
    )


def hall() -> ZoneKind:
    """Return a hall whose walls are beyond the depth camera's range, its floor polished stone."""
    tall = tuple((left, 1.6, 1.5, 2.0, poster) for left in (1.0, 4.6, 8.2, 11.8, 15.4))
    wide = tuple((left, 1.7, 1.8, 1.4, painting) for left in (2.0, 6.0, 10.0, 14.0, 17.2))
    ends: Pictures = ((1.0, 1.6, 1.4, 2.0, poster), (4.2, 1.8, 2.0, 1.5, painting))
    ends += ((10.2, 1.8, 2.0, 1.5, painting), (13.4, 1.6, 1.4, 2.0, poster))
    return ZoneKind(
        name="hall",
        size_m=(20.0, 16.0, 4.5),
        south_m=-8.0,
        exit_xy_m=(20.0, 0.0),
        route=_HALL_ROUTE,
        furnish=_furnish_hall,
        floor=stone_tiles,
        wall=brick,
        ceiling=plain(WHITE),
        pictures={"south": tall, "north": wide, "west": ends, "east": ends},
        lamps=tuple((float(x), float(y), 1.5, 0.4) for x in (3, 8, 13, 17) for y in (-5, 0, 5)),
        power=9.0,
        has_polished_floor=True,
        slippery=(
            ((10.0, 11.0), (-3.0, -0.6), 0.3),
            ((7.0, 10.0), (0.9, 1.6), 0.3),
            ((12.5, 18.0), (-1.0, 1.5), 0.2),
        ),
    )


def poster_corridor() -> ZoneKind:
    """Return the long lit corridor between the rows: flat walls with posters."""
    length_m = ROWS_APART_M + _CORRIDOR_M
    spots = np.arange(1.6, length_m - 1.5, 2.3)
    return _corridor(
        "corridor",
        wall=paint(WHITE),
        pictures={
            "west": tuple((3.0 + 2.4 * k, 0.6, 0.8, 1.0, poster) for k in range(3)),
            "east": tuple((float(left), 0.55, 1.0, 1.1, poster) for left in spots),
            "north": ((0.6, 0.7, 0.9, 0.8, painting),),
            "south": ((0.6, 0.7, 0.9, 0.8, painting),),
        },
        power=1.8,
        is_lit=True,
    )


def bare_corridor() -> ZoneKind:
    """Return the dark, empty corridor: only wheels and gyro measure its length."""
    return _corridor("bare", wall=paint((176, 180, 184)), pictures={}, power=1.8, is_lit=False)


def _corridor(
    name: str, *, wall: Material, pictures: Mapping[str, Pictures], power: float, is_lit: bool
) -> ZoneKind:
    length_m, middle_m = ROWS_APART_M + _CORRIDOR_M, _CORRIDOR_M / 2
    lamps = tuple((middle_m, float(y), 0.25, 0.9) for y in np.arange(0.0, ROWS_APART_M + 1, 2.5))
    return ZoneKind(
        name=name,
        size_m=(_CORRIDOR_M, length_m, 2.5),
        south_m=-middle_m,
        exit_xy_m=(0.0, ROWS_APART_M),
        route=((middle_m, 0.0), (middle_m, ROWS_APART_M)),
        furnish=_leave_empty,
        floor=carpet_tiles,
        wall=wall,
        ceiling=plain(WHITE),
        pictures=pictures,
        lamps=lamps,
        power=power,
        is_lit=is_lit,
    )


def atrium() -> ZoneKind:
    """Return the atrium: no roof, windows to the south, sunlight everywhere."""
    bricks: Pictures = ((0.6, 1.6, 1.2, 1.6, poster), (3.0, 1.8, 1.6, 1.2, painting))
    bricks += ((5.6, 1.5, 1.2, 1.7, poster), (8.6, 1.7, 1.6, 1.3, painting))
    ends = ((0.8, 1.7, 1.5, 1.5, painting), (7.6, 1.6, 1.3, 1.8, poster))
    return ZoneKind(
        name="atrium",
        size_m=(12.0, 11.0, 4.4),
        south_m=-5.5,
        exit_xy_m=(12.0, 0.0),
        route=((1.0, 0.0), (3.0, -0.5), (5.2, -2.4), (8.0, -2.2), (9.5, -0.5), (11.0, 0.0)),
        furnish=_furnish_atrium,
        floor=stone_tiles,
        wall=brick,
        ceiling=None,
        pictures={"north": bricks, "west": ends, "east": ends},
        windows={"south": (1.5, 1.9, 9.0, 2.1)},
        slippery=(((5.0, 9.0), (-4.0, 1.0), 0.2),),
    )


def store() -> ZoneKind:
    """Return the store room: lights off, images of noise only, sheets of foil on the floor."""
    return ZoneKind(
        name="store",
        size_m=(12.0, 6.0, 2.5),
        south_m=-3.0,
        exit_xy_m=(12.0, 0.0),
        route=((0.9, 0.0), (2.6, 0.9), (5.0, -0.9), (7.4, 0.9), (9.6, -0.5), (11.1, 0.0)),
        furnish=_furnish_store,
        floor=floorboards((46, 64, 86)),
        wall=paint((96, 92, 88)),
        ceiling=plain((96, 92, 88)),
        lamps=tuple((x_m, 0.0, 1.2, 0.3) for x_m in (2.0, 6.0, 10.0)),
        power=6.0,
        is_lit=False,
        slippery=tuple(((x_m, x_m + 1.2), (-2.0, 2.0), 0.35) for x_m in (3.2, 6.2, 8.6)),
    )


def ramp() -> ZoneKind:
    """Return the zone with a ramp of 8 degrees, up and down, and a door sill."""
    top_m, foot = _RAMP_M * float(np.tan(np.deg2rad(_RAMP_DEG))), 1.8
    up, down, end = foot + _RAMP_M, foot + _RAMP_M + 2.4, foot + 2 * _RAMP_M + 2.4
    pictures = tuple((0.8 + 2.1 * k, 0.7, 0.8, 1.0, poster) for k in range(6))
    sill = ((13.3, 0.0), (13.36, 0.012), (13.44, 0.012), (13.5, 0.0))
    return ZoneKind(
        name="ramp",
        size_m=(14.0, 2.6, 3.1),
        south_m=-1.3,
        exit_xy_m=(14.0, 0.0),
        route=((1.0, 0.0), (13.0, 0.0)),
        furnish=_leave_empty,
        floor=carpet_tiles,
        wall=paint(WHITE),
        ceiling=plain(WHITE),
        pictures={"south": pictures, "north": pictures},
        lamps=tuple((float(x), 0.0, 0.9, 0.25) for x in np.arange(1.0, 14.0, 2.4)),
        power=1.5,
        heights=((foot, 0.0), (up, top_m), (down, top_m), (end, 0.0), *sill),
        slippery=(((foot, up), (-1.3, 1.3), 0.06), ((13.28, 13.46), (-1.3, 1.3), 0.4)),
    )


def lobby(name: str, length_m: float) -> ZoneKind:
    """Return a lit passage of any length, which makes both rows equally long."""
    count = max(1, int(length_m / 2.0))
    pictures = tuple((0.4 + 2.0 * k, 0.6, 0.8, 1.0, poster) for k in range(count))
    return ZoneKind(
        name=name,
        size_m=(length_m, 3.0, 2.5),
        south_m=-1.5,
        exit_xy_m=(length_m, 0.0),
        route=((length_m / 2, 0.0),),
        furnish=_leave_empty,
        floor=floorboards(OAK),
        wall=paint(WHITE),
        ceiling=plain(WHITE),
        pictures={"south": pictures, "north": pictures},
        lamps=tuple((1.0 + 2.0 * k, 0.0, 0.6, 0.6) for k in range(count)),
        power=1.7,
    )


def _leave_empty(builder: PanelBuilder, twin_seed: int) -> None:
    """Put up nothing."""


def _furnish_office(builder: PanelBuilder, twin_seed: int) -> None:
    for x_m, y_m, yaw_deg in ((2.2, 2.0, 0), (4.6, 2.1, 5), (3.0, -2.1, 180), (5.4, -2.0, 175)):
        table(builder, Spot(x_m, y_m, yaw_deg), (1.4, 0.7, 0.74), wood(BIRCH, 1.5))
        side = -0.75 if y_m > 0 else 0.75
        chair(builder, Spot(x_m + 0.2, y_m + side, 160), wood(OAK), fabric((90, 60, 110)))
        builder.box((x_m - 0.3, y_m), (0.5, 0.05, 0.35), painting, bottom_m=0.74, yaw_deg=yaw_deg)
    bookshelf(builder, Spot(0.17, 2.1, 90), (1.3, 1.9), BIRCH)
    bookshelf(builder, Spot(0.17, -2.0, 90), (1.4, 1.8), OAK)
    bookshelf(builder, Spot(7.83, 2.0, -90), (1.3, 1.9), WALNUT)
    cabinet(builder, Spot(7.7, -2.2, -90), (0.9, 0.42, 1.0), wood(BIRCH, 1.4))
    cabinet(builder, Spot(6.6, 2.75, 0), (0.8, 0.42, 0.9), wood(OAK, 1.5))
    plant(builder, Spot(7.5, 1.0), 1.2)
    plant(builder, Spot(0.9, -2.6), 1.1)
    parcels(builder, Spot(6.9, -2.5, 178))


def _furnish_twin(builder: PanelBuilder, twin_seed: int) -> None:
    own_rng, builder.rng = builder.rng, np.random.default_rng(twin_seed)
    sofa(builder, Spot(2.5, 1.72), 1.9, (128, 158, 172))
    sideboard(builder, Spot(2.6, -2.0, 180), 1.5)
    bookshelf(builder, Spot(0.17, 1.45, 90), (1.2, 1.8), WALNUT)
    cabinet(builder, Spot(4.75, -1.5, -90), (0.8, 0.42, 0.9), wood(BIRCH, 1.4))
    plant(builder, Spot(4.5, 1.6), 1.2)
    table(builder, Spot(0.9, -1.5, 4), (0.8, 0.6, 0.6), wood(OAK, 1.6))
    for at, yaw_deg in (((4.985, 1.15), 90), ((0.015, -1.3), 90)):
        builder.box(at, (0.7, 0.02, 0.9), painting, bottom_m=1.0, yaw_deg=yaw_deg)
    builder.rng = own_rng
    builder.box((0.9, -1.5), (0.3, 0.2, 0.2), painting, bottom_m=0.6, yaw_deg=25)


def _furnish_hall(builder: PanelBuilder, twin_seed: int) -> None:
    for x_m in (2.0, 10.0, 18.0):
        sofa(builder, Spot(x_m, 7.4), 2.2, (90, 110, 150))
        plant(builder, Spot(x_m - 1.6, -7.4), 1.4)
        plant(builder, Spot(x_m + 1.4, 7.3), 1.5)


def _furnish_atrium(builder: PanelBuilder, twin_seed: int) -> None:
    for x_m in np.arange(0.6, 12.0, 2.1):  # the roof: boards with glass between them
        builder.level((x_m - 0.6, x_m + 0.8), (-5.5, 5.5), 4.4, plain(WHITE), faces_up=False)
    for x_m, y_m in ((1.2, 4.6), (4.2, 4.7), (7.4, 4.6), (10.6, 4.6), (1.0, -2.4), (10.8, -3.0)):
        plant(builder, Spot(x_m, y_m), 1.5)
    table(builder, Spot(5.6, 2.6, 10), (1.0, 1.0, 0.74), wood(OAK, 1.6))
    chair(builder, Spot(5.0, 2.0, 30), wood(OAK), fabric((60, 90, 140)))
    chair(builder, Spot(6.4, 3.2, 200), wood(OAK), fabric((110, 70, 40)))


def _furnish_store(builder: PanelBuilder, twin_seed: int) -> None:
    for x_m in (1.7, 4.0, 6.3, 8.6):
        bookshelf(builder, Spot(x_m, 2.8, 0), (1.6, 1.9), OAK)
        bookshelf(builder, Spot(x_m + 1.2, -2.8, 180), (1.4, 2.0), BIRCH)
    spots = ((2.9, 2.2, 20), (5.6, -2.1, 160), (1.2, -2.0, 10), (10.8, 2.0, 40), (10.9, -2.2, 120))
    for x_m, y_m, yaw_deg in spots:
        parcels(builder, Spot(x_m, y_m, yaw_deg))
