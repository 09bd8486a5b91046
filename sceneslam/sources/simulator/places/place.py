"""A simulated place: flat textured panels, lamps and the sun."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.places.surfaces import TEXEL_M, Material, Texture
from sceneslam.sources.simulator.places.walker import Walker
from sceneslam.types import se3
from sceneslam.types.se3 import Transform

Vector = NDArray[np.float64]
Rectangle = tuple[float, float, float, float]  # left, top, width, height [m]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """A parallelogram; on its visible side, u points right and v down."""

    corner_m: Vector  # (3,), top left, frame gt
    edge_u_m: Vector  # (3,), along the texture's columns
    edge_v_m: Vector  # (3,), along the texture's rows
    texture: Texture
    is_polished: bool = False  # reflects the depth camera's pattern away: no depth

    @property
    def normal(self) -> Vector:
        """Return the unit normal (3,), gt, towards the visible side."""
        normal = np.cross(self.edge_v_m, self.edge_u_m)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, slots=True, kw_only=True)
class Lamp:
    """A flat ceiling light that emits downwards by Lambert's law."""

    group: str  # lamps of one group share a switch
    centre_m: tuple[float, float, float]
    size_xy_m: tuple[float, float]
    power: float  # irradiance at 1 m in front of it; at 1, white is white in the image
    points_per_side: int = 4  # point lights per side of a square grid
    reach_m: float = np.inf  # no direct light beyond


@dataclass(frozen=True, slots=True, kw_only=True)
class Sun:
    """Parallel light, and the sky that is visible where a ray leaves the place."""

    direction: tuple[float, float, float]  # from the sun
    power: float  # irradiance on a surface that faces it
    sky: float  # radiance of the sky
    blinding: float = 0.02  # irradiance above which there is no depth


SUN = "sun"  # the group of the sun
NIGHT = "night"  # the group of stand-by lights and street lamps, always on


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedPlace:
    """All surfaces, lights and people of a place."""

    panels: tuple[Panel, ...]
    lamps: tuple[Lamp, ...]
    sun: Sun | None = None
    people: tuple[Walker, ...] = ()
    cell_m: float = 0.06  # of the light map

    @property
    def groups(self) -> tuple[str, ...]:
        """Return the lamp groups in order of appearance, the sun last."""
        names = dict.fromkeys(lamp.group for lamp in self.lamps)
        return (*names, SUN) if self.sun else tuple(names)


@dataclass(slots=True)
class PanelBuilder:
    """Collects panels; their textures are drawn from one generator, in order."""

    rng: np.random.Generator
    panels: list[Panel] = field(default_factory=list)
    T_gt_local: Transform = field(default_factory=se3.identity)  # frame of the next panels
    is_polished: bool = False  # of the next panels

    def panel(self, corner_m: Vector, edge_u_m: Vector, edge_v_m: Vector, look: Material) -> None:
        """Add one panel."""
        size = float(np.linalg.norm(edge_u_m)), float(np.linalg.norm(edge_v_m))
        self._put(corner_m, edge_u_m, edge_v_m, look(self.rng, *size))

    def wall(
        self,
        left_xy_m: tuple[float, float],
        right_xy_m: tuple[float, float],
        heights_m: tuple[float, float],
        look: Material,
        *,
        hole_m: Rectangle | None = None,
    ) -> None:
        """Add a vertical panel; left and right are seen from its front, heights (bottom, top).

        A hole (left, top, width, height) is measured from the panel's top left corner.
        """
        bottom, top = heights_m
        across = np.array([*np.subtract(right_xy_m, left_xy_m), 0.0])
        corner, down = np.array([*left_xy_m, top]), np.array([0, 0, bottom - top])
        if hole_m is None:
            self.panel(corner, across, down, look)
            return
        width_m, height_m = float(np.linalg.norm(across)), top - bottom
        texture = look(self.rng, width_m, height_m)
        across, down = across / width_m, down / height_m
        for left_m, top_m, wide_m, high_m in _around(hole_m, width_m, height_m):
            rows = slice(round(top_m / TEXEL_M), round((top_m + high_m) / TEXEL_M))
            columns = slice(round(left_m / TEXEL_M), round((left_m + wide_m) / TEXEL_M))
            self._put(
                corner + across * left_m + down * top_m,
                across * wide_m,
                down * high_m,
                np.ascontiguousarray(texture[rows, columns]),
            )

    def level(
        self,
        x_m: tuple[float, float],
        y_m: tuple[float, float],
        height_m: float,
        look: Material,
        *,
        faces_up: bool = True,
    ) -> None:
        """Add a horizontal panel: a floor, or a ceiling if it does not face up."""
        across, along = np.array([x_m[1] - x_m[0], 0, 0]), np.array([0, y_m[1] - y_m[0], 0])
        if faces_up:
            self.panel(np.array([x_m[0], y_m[1], height_m]), across, -along, look)
        else:
            self.panel(np.array([x_m[0], y_m[0], height_m]), across, along, look)

    def box(
        self,
        centre_xy_m: tuple[float, float],
        size_m: tuple[float, float, float],
        look: Material,
        *,
        bottom_m: float = 0.0,
        yaw_deg: float = 0.0,
        looks: Mapping[str, Material] | None = None,
    ) -> None:
        """Add a box standing on `bottom_m`; `looks` overrides: front (-y) back left right top."""
        ex, ey = _axes(yaw_deg)
        length, depth, height = size_m
        middle = np.array([*centre_xy_m, bottom_m + height])
        down = np.array([0, 0, -height])
        own = looks or {}
        sides = {"front": (-ey, depth, ex, length), "back": (ey, depth, -ex, length)}
        sides |= {"right": (ex, length, ey, depth), "left": (-ex, length, -ey, depth)}
        for name, (outward, reach, across, width) in sides.items():
            corner = middle + outward * reach / 2 - across * width / 2
            self.panel(corner, across * width, down, own.get(name, look))
        corner = middle - ex * length / 2 + ey * depth / 2
        self.panel(corner, ex * length, -ey * depth, own.get("top", look))
        if bottom_m > 0.02:
            corner = middle + down - ex * length / 2 - ey * depth / 2
            self.panel(corner, ex * length, ey * depth, look)

    def _put(self, corner_m: Vector, edge_u_m: Vector, edge_v_m: Vector, texture: Texture) -> None:
        turn = self.T_gt_local[:3, :3]
        self.panels.append(
            Panel(
                corner_m=se3.apply(self.T_gt_local, np.asarray(corner_m, float)[None])[0],
                edge_u_m=turn @ np.asarray(edge_u_m, float),
                edge_v_m=turn @ np.asarray(edge_v_m, float),
                texture=texture,
                is_polished=self.is_polished,
            )
        )


def _axes(yaw_deg: float) -> tuple[Vector, Vector]:
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    return np.array([c, s, 0.0]), np.array([-s, c, 0.0])


def _around(hole_m: Rectangle, width_m: float, height_m: float) -> list[Rectangle]:
    """Return the rectangles that remain of a panel around its hole."""
    left, top, wide, high = hole_m
    right, bottom = left + wide, top + high
    parts = [
        (0.0, 0.0, left, height_m),
        (right, 0.0, width_m - right, height_m),
        (left, 0.0, wide, top),
        (left, bottom, wide, height_m - bottom),
    ]
    return [part for part in parts if min(part[2:]) > 1e-6]
