"""Simulated floor plans of walls with a planar laser, fast enough for many runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import planar
from sceneslam.types.observation import LaserScan
from sceneslam.types.planar import Planar

Wall = tuple[float, float, float, float]  # x, y of both ends [m]
Corner = tuple[float, float]


def box(x0: float, y0: float, x1: float, y1: float) -> list[Wall]:
    """Return the walls of a rectangle."""
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


CUPBOARD = box(1, 1, 1.8, 2)  # in `flat`


def flat() -> list[Wall]:
    """Return two furnished rooms, 6 x 5 m and 4 x 4 m, with a door between."""
    first: list[Wall] = [(0, 0, 6, 0), (6, 0, 6, 1.5), (6, 2.5, 6, 5), (6, 5, 0, 5), (0, 5, 0, 0)]
    second: list[Wall] = [(6, 0, 10, 0), (10, 0, 10, 4), (10, 4, 6, 4)]
    return [*first, *second, *CUPBOARD, *box(4, 3.2, 4.6, 4.2), *box(8, 2.6, 9, 3.2)]


FLAT_TOUR: tuple[Corner, ...] = (
    (0.6, 2.6),
    (3.0, 2.4),
    (3.2, 0.8),
    (5.4, 0.9),
    (5.4, 2.0),
    (7.4, 2.0),
    (7.3, 0.8),
    (9.3, 0.9),
    (9.4, 1.9),
    (5.3, 2.0),
    (2.9, 2.6),
    (3.0, 4.4),
    (0.7, 4.2),
    (0.6, 2.8),
)


def twins() -> list[Wall]:
    """Return two identical rooms beside one corridor."""
    walls: list[Wall] = [(0, -2, 16, -2), (0, -2, 0, 0), (16, -2, 16, 0)]
    for x in (0.0, 8.0):
        walls += [(x, 0, x, 4), (x, 4, x + 5, 4), (x + 5, 4, x + 5, 0)]
        walls += [(x, 0, x + 2, 0), (x + 3, 0, x + 8, 0), *box(x + 1, 2.5, x + 1.8, 3.2)]
    return walls


TWINS_FIRST: tuple[Corner, ...] = ((1.0, 1.0), (4.2, 1.2), (4.2, 3.4), (2.5, 2.0), (2.5, -1.0))
TWINS_SECOND: tuple[Corner, ...] = tuple((x + 8.0, y) for x, y in reversed(TWINS_FIRST))


def niches(count: int, every_m: float = 3.0) -> list[Wall]:
    """Return a corridor, 2 m wide, with identical niches."""
    length_m = count * every_m
    walls: list[Wall] = [(0, -1, length_m, -1), (0, -1, 0, 1), (length_m, -1, length_m, 1)]
    for number in range(count):
        x = number * every_m
        walls += [(x, 1, x + 1, 1), (x + 2, 1, x + 3, 1), (x + 1, 1, x + 1, 1.6)]
        walls += [(x + 1, 1.6, x + 2, 1.6), (x + 2, 1.6, x + 2, 1)]
    return walls


def corridor(length_m: float = 40.0) -> list[Wall]:
    """Return a bare corridor whose ends are out of range."""
    return [(-length_m, -1, length_m, -1), (-length_m, 1, length_m, 1)]


@dataclass(slots=True, kw_only=True)
class Scanner:
    """A planar laser; with other values, similar to a depth camera."""

    beams: int = 270
    field_rad: float = 1.5 * np.pi
    range_m: float = 10.0
    noise_m: float = 0.01


DEPTH_LIKE = Scanner(beams=160, field_rad=float(np.radians(57.0)), range_m=4.5, noise_m=0.015)


@dataclass(slots=True)
class World:
    """Walls and a laser."""

    walls: Sequence[Wall]
    rng: np.random.Generator
    scanner: Scanner

    def scan(self, T_world_base: Planar, stamp_ns: int = 0) -> LaserScan:
        """Return the laser's scan at T_world_base (3,); the laser is at the origin of `base`."""
        scanner = self.scanner
        angles = np.linspace(-scanner.field_rad / 2, scanner.field_rad / 2, scanner.beams)
        hit_m = self.hit(T_world_base, angles)
        hit_m = hit_m + self.rng.normal(0.0, scanner.noise_m, scanner.beams)
        return LaserScan(
            stamp_ns=stamp_ns,
            ranges_m=np.where(hit_m < scanner.range_m, hit_m, np.inf).astype(np.float32),
            angle_min_rad=float(angles[0]),
            angle_step_rad=float(angles[1] - angles[0]),
            range_min_m=0.05,
            range_max_m=scanner.range_m,
        )

    def hit(self, T_world_base: Planar, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (beams,) [m] to each beam's first wall, inf without one."""
        walls = np.array(self.walls, np.float64)
        yaw = T_world_base[2] + angles
        dx, dy = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        (ex, ey), (wx, wy) = (walls[:, 2:] - walls[:, :2]).T, (walls[:, :2] - T_world_base[:2]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            across = dx * ey - dy * ex
            range_m = (wx * ey - wy * ex) / across
            share = (wx * dy - wy * dx) / across
        is_hit = (range_m > 0) & (share >= 0) & (share <= 1)
        return np.asarray(np.where(is_hit, range_m, np.inf).min(axis=1))


def through(corners: Sequence[Corner], step_m: float = 0.1) -> NDArray[np.float64]:
    """Return the poses (N, 3), x, y [m], yaw [rad], of a drive along straight lines with turns."""
    poses: list[list[float]] = []
    for (x0, y0), (x1, y1) in pairwise(corners):
        yaw = float(np.arctan2(y1 - y0, x1 - x0))
        if poses:
            turn = planar.wrap(yaw - poses[-1][2])
            count = int(abs(turn) / 0.2)
            start = poses[-1][2]
            poses += [[x0, y0, start + turn * (i + 1) / count] for i in range(count)]
        count = max(int(np.hypot(x1 - x0, y1 - y0) / step_m), 1)
        shares = [i / count for i in range(count + 1)]
        poses += [[x0 + (x1 - x0) * part, y0 + (y1 - y0) * part, yaw] for part in shares]
    return np.array([[x, y, planar.wrap(yaw)] for x, y, yaw in poses])
