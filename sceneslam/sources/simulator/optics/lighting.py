"""Illumination of a place: each lamp group's light by ray casting, with shadows and reflections.

The unit of irradiance is that at which a perfect reflector is white in the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.optics.rays import RayCaster
from sceneslam.sources.simulator.optics.sheet import Sheet, pack
from sceneslam.sources.simulator.places.place import SUN, Lamp, Panel, SimulatedPlace, Sun

_LIFT_M = 0.002  # offset of a ray's origin from its panel
_BOUNCE_RAYS = 64
_BOUNCES = 4
_SHEET_COLUMNS = 1024

Values = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LightMap:
    """The irradiance by each lamp group, on a sheet with one block per panel."""

    groups: tuple[str, ...]
    irradiance: Values  # (groups, rows, columns, 3), BGR
    lookup: Values  # (2 panels, 4), see Sheet.lookup


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Cells:
    """The light map's cells, block by block, row by row."""

    points: Values  # (N, 3) [m], just above the panel
    normals: Values  # (N, 3)
    albedo: Values  # (N, 3), linear
    first: NDArray[np.int64]  # (panels,), index of each block's first cell


def bake(place: SimulatedPlace, caster: RayCaster, rng: np.random.Generator) -> LightMap:
    """Return the light of every lamp group of a place at full power."""
    sheet = pack(_block_sizes(place), _SHEET_COLUMNS)
    cells = _cells(place, sheet)
    direct = np.stack([_direct(group, place, cells, caster) for group in place.groups], axis=1)
    sky = [place.sun.sky if place.sun and group == SUN else 0.0 for group in place.groups]
    seen = _gather(cells, sheet, caster, rng)
    bounced = _bounce(direct, np.array(sky, np.float32), cells.albedo, seen)
    canvas = np.zeros((len(place.groups), *sheet.shape, 3), np.float32)
    for index, start in enumerate(cells.first):
        wide, high = sheet.size_wh[index]
        block = slice(start, start + wide * high)
        for group in range(len(place.groups)):
            soft = _smooth(bounced[block, group].reshape(high, wide, 3))
            hard = direct[block, group].reshape(high, wide, 1)
            sheet.paste(canvas[group], index, np.maximum(soft, 0.0) + hard)
    return LightMap(groups=place.groups, irradiance=canvas, lookup=sheet.lookup())


def _block_sizes(place: SimulatedPlace) -> NDArray[np.int64]:
    edges = np.array([(panel.edge_u_m, panel.edge_v_m) for panel in place.panels])
    cells = np.rint(np.linalg.norm(edges, axis=2) / place.cell_m)
    return np.asarray(np.maximum(2, cells), dtype=np.int64)


def _cells(place: SimulatedPlace, sheet: Sheet) -> _Cells:
    counts = sheet.size_wh.prod(axis=1)
    parts = [
        _block_cells(panel, int(wide), int(high))
        for panel, (wide, high) in zip(place.panels, sheet.size_wh, strict=True)
    ]
    normals = np.stack([panel.normal for panel in place.panels])
    return _Cells(
        points=np.concatenate([points for points, _ in parts]).astype(np.float32),
        normals=np.repeat(normals, counts, axis=0).astype(np.float32),
        albedo=np.concatenate([albedo for _, albedo in parts]).astype(np.float32),
        first=np.concatenate([[0], np.cumsum(counts)[:-1]]),
    )


def _block_cells(panel: Panel, wide: int, high: int) -> tuple[NDArray[np.float64], Values]:
    """Return the centres (N, 3) [m], gt, and linear reflectances (N, 3) of a panel's cells."""
    t, s = np.meshgrid(
        (np.arange(high) + 0.5) / high, (np.arange(wide) + 0.5) / wide, indexing="ij"
    )
    across, down = s.reshape(-1, 1) * panel.edge_u_m, t.reshape(-1, 1) * panel.edge_v_m
    linear = (panel.texture.astype(np.float32) / 255.0) ** 2
    albedo = cv2.resize(linear, (wide, high), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    return panel.corner_m + across + down + _LIFT_M * panel.normal, np.asarray(albedo, np.float32)


def _direct(group: str, place: SimulatedPlace, cells: _Cells, caster: RayCaster) -> Values:
    """Return the direct irradiance (N,) by the lamps of a group, or by the sun."""
    total = np.zeros(len(cells.points), np.float32)
    if group == SUN and place.sun:
        _shine(total, cells, caster, *_sun_rays(place.sun, cells))
    for lamp in place.lamps:
        if lamp.group == group:
            for point_m in _lamp_points(lamp):
                _shine(total, cells, caster, *_lamp_rays(lamp, point_m, cells))
    return total


def _shine(
    total: Values, cells: _Cells, caster: RayCaster, towards: Values, irradiance: Values
) -> None:
    """Add, in place, the irradiance along rays that are not blocked."""
    lit = np.flatnonzero(irradiance > 0)
    rays = np.concatenate([cells.points[lit], towards[lit]], axis=1)
    total[lit] += np.where(caster.is_blocked(rays, reach=0.999), 0.0, irradiance[lit])


def _sun_rays(sun: Sun, cells: _Cells) -> tuple[Values, Values]:
    towards = -np.array(sun.direction) / np.linalg.norm(sun.direction)
    cosine = (cells.normals * towards.astype(np.float32)).sum(axis=1)
    rays = np.broadcast_to((50.0 * towards).astype(np.float32), cells.points.shape)
    return rays, np.asarray(sun.power * np.maximum(cosine, 0.0), np.float32)


def _lamp_rays(lamp: Lamp, point_m: NDArray[np.float64], cells: _Cells) -> tuple[Values, Values]:
    """Return the vectors to a point of a lamp and its irradiance: Lambert's law, 1 / r^2."""
    towards = (point_m - cells.points).astype(np.float32)
    square_m2 = np.maximum((towards**2).sum(axis=1), 1e-4)
    down = np.maximum(towards[:, 2], 0.0)  # cosine at the lamp, times r
    cosine = np.maximum((towards * cells.normals).sum(axis=1), 0.0)
    power = lamp.power / lamp.points_per_side**2
    share = np.where(square_m2 > lamp.reach_m**2, np.float32(0.0), np.float32(power))
    return towards, np.asarray(share * down * cosine / square_m2**2, np.float32)


def _lamp_points(lamp: Lamp) -> NDArray[np.float64]:
    steps = (np.arange(lamp.points_per_side) + 0.5) / lamp.points_per_side - 0.5
    x, y = np.meshgrid(steps * lamp.size_xy_m[0], steps * lamp.size_xy_m[1])
    return np.array(lamp.centre_m) + np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def _gather(
    cells: _Cells, sheet: Sheet, caster: RayCaster, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return (rays, N): the cells that each cell's cosine-weighted rays hit.

    Index N is the back of a panel (black), N + 1 the sky.
    """
    count, lookup = len(cells.points), sheet.lookup()
    spin = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    helper = np.where(np.abs(cells.normals[:, 2:]) < 0.9, [[0, 0, 1]], [[1, 0, 0]])
    side = np.cross(helper, cells.normals)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(cells.normals, side)
    seen = np.empty((_BOUNCE_RAYS, count), np.int64)
    for k in range(_BOUNCE_RAYS):  # Fibonacci lattice on the unit disc, projected to the sphere
        radius = np.sqrt((k + 0.5) / _BOUNCE_RAYS)
        x, y = radius * np.cos(spin + 2.399963 * k), radius * np.sin(spin + 2.399963 * k)
        way = side * x[:, None] + other * y[:, None] + cells.normals * np.sqrt(1 - radius**2)
        rays = np.concatenate([cells.points, way], axis=1).astype(np.float32)
        hits = caster.first_hits(rays)
        panel = hits.triangle // 2
        at = lookup[hits.triangle]
        column = np.rint(at[:, 0] + at[:, 1] * hits.uv[:, 0]) - sheet.left_top[panel, 0]
        row = np.rint(at[:, 2] + at[:, 3] * hits.uv[:, 1]) - sheet.left_top[panel, 1]
        wide, high = sheet.size_wh[panel].T
        cell = np.clip(row, 0, high - 1) * wide + np.clip(column, 0, wide - 1)
        index = cells.first[panel] + cell.astype(np.int64)
        index[(way * cells.normals[index]).sum(axis=1) > 0] = count
        index[~np.isfinite(hits.reach)] = count + 1
        seen[k] = index
    return seen


def _bounce(direct: Values, sky: Values, albedo: Values, seen: NDArray[np.int64]) -> Values:
    """Return the irradiance (N, groups, 3) reflected by other cells, by iterated gathering."""
    count, groups = direct.shape
    source = np.zeros((count + 2, groups, 3), np.float32)
    source[count + 1] = sky[:, None]
    bounced = np.zeros((count, groups, 3), np.float32)
    # Radiosity by iteration: B = albedo (E_direct + E_bounced), E_bounced = mean of B over rays.
    for _ in range(_BOUNCES):
        source[:count] = albedo[:, None] * (direct[..., None] + bounced)
        bounced[:] = 0.0
        for cells_seen in seen:
            bounced += source[cells_seen]
        bounced /= len(seen)
    return bounced


def _smooth(block: Values) -> Values:
    """Return a block smoothed against the noise of few rays."""
    for _ in range(3):
        block = np.asarray(cv2.blur(block, (3, 3), borderType=cv2.BORDER_REPLICATE))
    return block
