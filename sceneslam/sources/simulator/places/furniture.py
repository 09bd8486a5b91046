"""Furniture, built from boxes and flat panels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneslam.sources.simulator.places.pictures import decorated, poster, spines
from sceneslam.sources.simulator.places.place import PanelBuilder
from sceneslam.sources.simulator.places.surfaces import (
    OAK,
    WALNUT,
    WHITE,
    Colour,
    Material,
    cardboard,
    fabric,
    leaf,
    paint,
    wood,
)


@dataclass(frozen=True, slots=True)
class Spot:
    """The position of a piece and the heading of its x axis; its front is -y."""

    x_m: float
    y_m: float
    yaw_deg: float = 0.0

    def at(self, right_m: float, back_m: float) -> tuple[float, float]:
        """Return a point of the piece, given by its distance to the right and back, in `gt` [m]."""
        c, s = np.cos(np.deg2rad(self.yaw_deg)), np.sin(np.deg2rad(self.yaw_deg))
        return (
            float(self.x_m + c * right_m - s * back_m),
            float(self.y_m + s * right_m + c * back_m),
        )


def bookshelf(
    builder: PanelBuilder, spot: Spot, size_m: tuple[float, float], colour: Colour
) -> None:
    """Add a bookshelf, 30 cm deep, filled with books."""
    case, rng, depth_m, (width_m, height_m) = wood(colour), builder.rng, 0.3, size_m
    for side in (-1, 1):
        place = spot.at(side * (width_m - 0.02) / 2, 0)
        builder.box(place, (0.02, depth_m, height_m), case, yaw_deg=spot.yaw_deg)
    back = spot.at(0, depth_m / 2 - 0.005)
    builder.box(back, (width_m - 0.04, 0.01, height_m), case, yaw_deg=spot.yaw_deg)
    boards = np.arange(0.06, height_m, 0.34)
    for board_m in boards:
        size = (width_m - 0.04, depth_m - 0.01, 0.02)
        centre = spot.at(0, -0.005)
        builder.box(centre, size, case, bottom_m=board_m, yaw_deg=spot.yaw_deg)
    for board_m in boards[:-1]:
        left_m = -width_m / 2 + 0.03
        while left_m < width_m / 2 - 0.12:
            block_m = min(rng.uniform(0.1, 0.32), width_m / 2 - 0.03 - left_m)
            deep_m, high_m = rng.uniform(0.15, 0.25), rng.uniform(0.18, 0.29)
            centre = spot.at(left_m + block_m / 2, (depth_m - deep_m) / 2 - 0.02)
            _books(builder, centre, (block_m, deep_m, high_m), board_m + 0.02, spot.yaw_deg)
            left_m += block_m + float(rng.choice([0.0, 0.0, 0.08]))


def table(
    builder: PanelBuilder, spot: Spot, size_m: tuple[float, float, float], look: Material
) -> None:
    """Add a table on four legs."""
    width_m, depth_m, height_m = size_m
    top_m = height_m - 0.03
    yaw_deg = spot.yaw_deg
    builder.box(
        (spot.x_m, spot.y_m), (width_m, depth_m, 0.03), look, bottom_m=top_m, yaw_deg=yaw_deg
    )
    for right in (-1, 1):
        for back in (-1, 1):
            leg = spot.at(right * (width_m / 2 - 0.05), back * (depth_m / 2 - 0.05))
            builder.box(leg, (0.05, 0.05, top_m), look, yaw_deg=yaw_deg)


def chair(builder: PanelBuilder, spot: Spot, look: Material, seat: Material) -> None:
    """Add a chair."""
    table(builder, spot, (0.42, 0.42, 0.45), look)
    cushion, yaw_deg = (spot.x_m, spot.y_m), spot.yaw_deg
    builder.box(cushion, (0.4, 0.4, 0.04), seat, bottom_m=0.45, yaw_deg=yaw_deg)
    for right in (-0.18, 0.18):
        post = spot.at(right, 0.19)
        builder.box(post, (0.04, 0.03, 0.3), look, bottom_m=0.45, yaw_deg=yaw_deg)
    builder.box(spot.at(0, 0.19), (0.4, 0.03, 0.2), look, bottom_m=0.74, yaw_deg=yaw_deg)


def sofa(builder: PanelBuilder, spot: Spot, width_m: float, colour: Colour) -> None:
    """Add a sofa, 85 cm deep, with loose cushions."""
    cloth, rng, yaw_deg = fabric(colour), builder.rng, spot.yaw_deg
    builder.box(spot.at(0, -0.08), (width_m - 0.3, 0.68, 0.4), cloth, yaw_deg=yaw_deg)
    builder.box(spot.at(0, 0.33), (width_m, 0.2, 0.8), cloth, yaw_deg=yaw_deg)
    for side in (-1, 1):
        arm = spot.at(side * (width_m / 2 - 0.08), -0.08)
        builder.box(arm, (0.16, 0.7, 0.58), cloth, yaw_deg=yaw_deg)
    for right in np.linspace(-width_m / 2 + 0.45, width_m / 2 - 0.45, 3):
        blue, green, red = (int(level) for level in rng.integers(40, 200, 3))
        tilt = yaw_deg + float(rng.uniform(-20, 20))
        cushion = fabric((blue, green, red), 26.0)
        builder.box(spot.at(right, 0.14), (0.4, 0.13, 0.36), cushion, bottom_m=0.4, yaw_deg=tilt)


def cabinet(
    builder: PanelBuilder, spot: Spot, size_m: tuple[float, float, float], look: Material
) -> None:
    """Add a cabinet with drawers, and objects on top."""
    width_m, depth_m, height_m = size_m
    centre, yaw_deg, rng = (spot.x_m, spot.y_m), spot.yaw_deg, builder.rng
    builder.box(centre, size_m, look, yaw_deg=yaw_deg)
    for row_m in np.arange(0.08, height_m - 0.2, 0.26):
        drawer = spot.at(0, -depth_m / 2 - 0.008)
        size = (width_m - 0.05, 0.016, 0.23)
        builder.box(drawer, size, wood(OAK, 1.6), bottom_m=row_m, yaw_deg=yaw_deg)
        knob = spot.at(0, -depth_m / 2 - 0.03)
        builder.box(
            knob, (0.1, 0.03, 0.02), paint((40, 40, 42)), bottom_m=row_m + 0.11, yaw_deg=yaw_deg
        )
    _books(builder, spot.at(-width_m / 4, 0), (width_m / 3, 0.2, 0.24), height_m, yaw_deg)
    turned = yaw_deg + float(rng.uniform(-30, 30))
    thing = spot.at(width_m / 4, -0.02)
    builder.box(thing, (0.18, 0.16, 0.14), cardboard, bottom_m=height_m, yaw_deg=turned)


def sideboard(builder: PanelBuilder, spot: Spot, width_m: float) -> None:
    """Add a sideboard: bays with books or doors, and books on top."""
    rng, yaw_deg, look = builder.rng, spot.yaw_deg, wood((186, 200, 206), 0.8)
    for bottom_m in (0.05, 0.53):
        builder.box(spot.at(0, 0), (width_m, 0.36, 0.03), look, bottom_m=bottom_m, yaw_deg=yaw_deg)
    builder.box(spot.at(0, 0.17), (width_m, 0.01, 0.56), look, yaw_deg=yaw_deg)
    walls, bay_m = np.linspace(-width_m / 2, width_m / 2, 5), width_m / 4
    for right_m in walls:
        wall = spot.at(float(right_m) * (1 - 0.02 / width_m), 0)
        builder.box(wall, (0.02, 0.35, 0.48), look, bottom_m=0.05, yaw_deg=yaw_deg)
    sticker = decorated(paint(WHITE), (0.06, 0.07, 0.2, 0.3, poster))
    for number, right_m in enumerate(walls[:-1] + bay_m / 2):
        if number % 2:
            door = spot.at(right_m, -0.17)
            size = (bay_m - 0.03, 0.02, 0.44)
            looks = {"front": sticker}
            builder.box(door, size, look, bottom_m=0.085, yaw_deg=yaw_deg, looks=looks)
        else:
            size = (float(rng.uniform(0.28, 0.32)), 0.2, float(rng.uniform(0.3, 0.38)))
            _books(builder, spot.at(right_m, -0.06), size, 0.08, yaw_deg)
        top = (float(rng.uniform(0.12, 0.26)), 0.16, float(rng.uniform(0.1, 0.26)))
        _books(builder, spot.at(right_m - 0.05, -0.02), top, 0.56, yaw_deg)


def wall_shelf(builder: PanelBuilder, spot: Spot, width_m: float) -> None:
    """Add two small wall shelves, one above the other, with objects."""
    yaw_deg = spot.yaw_deg
    for bottom_m in (0.25, 0.6):
        centre = spot.at(0, 0)
        builder.box(centre, (width_m, 0.14, 0.02), wood(OAK), bottom_m=bottom_m, yaw_deg=yaw_deg)
        books = spot.at(-width_m / 4, 0.01)
        _books(builder, books, (width_m / 3, 0.11, 0.2), bottom_m + 0.02, yaw_deg)
        thing = spot.at(width_m / 4, 0)
        builder.box(thing, (0.1, 0.1, 0.14), cardboard, bottom_m=bottom_m + 0.02, yaw_deg=yaw_deg)


def door_leaf(builder: PanelBuilder, spot: Spot) -> None:
    """Add a white door leaf, 90 cm wide along x, with panels and a handle."""
    panel = paint((176, 186, 190))
    white = decorated(paint(WHITE), (0.15, 0.2, 0.6, 0.7, panel), (0.15, 1.1, 0.6, 0.7, panel))
    builder.box(spot.at(0, 0), (0.9, 0.04, 2.0), white, bottom_m=0.01, yaw_deg=spot.yaw_deg)
    handle = (0.12, 0.12, 0.03)
    at = spot.at(0.36, 0)
    builder.box(at, handle, paint((70, 72, 74)), bottom_m=1.02, yaw_deg=spot.yaw_deg)


def parcels(builder: PanelBuilder, spot: Spot) -> None:
    """Add a pile of cardboard boxes."""
    rng = builder.rng
    builder.box(spot.at(0, 0), (0.52, 0.42, 0.38), cardboard, yaw_deg=spot.yaw_deg)
    turned = spot.yaw_deg + float(rng.uniform(-25, 25))
    builder.box(spot.at(-0.04, 0.02), (0.42, 0.34, 0.3), cardboard, bottom_m=0.38, yaw_deg=turned)
    builder.box(spot.at(-0.5, 0.05), (0.34, 0.3, 0.27), cardboard, yaw_deg=-turned)


def plant(builder: PanelBuilder, spot: Spot, height_m: float) -> None:
    """Add a potted plant of about sixty two-sided leaves."""
    rng, pot_m = builder.rng, 0.32
    builder.box((spot.x_m, spot.y_m), (0.3, 0.3, pot_m), fabric((70, 96, 150), 5.0), yaw_deg=20)
    builder.box((spot.x_m, spot.y_m), (0.03, 0.03, height_m * 0.6), wood(WALNUT), bottom_m=pot_m)
    for _ in range(32):
        azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 1.1)
        out = np.array(
            [np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)]
        )
        side = np.array([-np.sin(azimuth), np.cos(azimuth), rng.uniform(-0.4, 0.4)])
        long_m, wide_m = rng.uniform(0.16, 0.3), rng.uniform(0.06, 0.11)
        stem = np.array([spot.x_m, spot.y_m, rng.uniform(pot_m + 0.1, height_m * 0.85)])
        root = stem + 0.05 * out - side * wide_m / 2
        builder.panel(root, side * wide_m, out * long_m, leaf)
        behind = 0.002 * np.cross(out, side)  # its other face
        builder.panel(root + side * wide_m - behind, -side * wide_m, out * long_m, leaf)


def bed(builder: PanelBuilder, spot: Spot) -> None:
    """Add a bed, 2 m long, with the headboard at the back."""
    yaw_deg = spot.yaw_deg
    builder.box(spot.at(0, 0), (0.95, 2.0, 0.28), wood(OAK), yaw_deg=yaw_deg)
    quilt = fabric((120, 96, 84), 20.0)
    builder.box(spot.at(0, -0.05), (0.93, 1.85, 0.22), quilt, bottom_m=0.28, yaw_deg=yaw_deg)
    pillow = fabric(WHITE, 4.0)
    builder.box(spot.at(0, 0.72), (0.6, 0.4, 0.12), pillow, bottom_m=0.5, yaw_deg=yaw_deg + 6)
    builder.box(spot.at(0, 1.02), (0.95, 0.05, 0.85), wood(OAK, 1.5), yaw_deg=yaw_deg)


def _books(
    builder: PanelBuilder,
    centre_xy_m: tuple[float, float],
    size_m: tuple[float, float, float],
    bottom_m: float,
    yaw_deg: float,
) -> None:
    paper = fabric((170, 190, 200), 3.0)
    looks = {"front": spines, "back": spines}
    builder.box(centre_xy_m, size_m, paper, bottom_m=bottom_m, yaw_deg=yaw_deg, looks=looks)
