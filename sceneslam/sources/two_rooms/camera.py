"""What a noise-free camera sees of a place: colour, depth and the angle of view of surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.two_rooms.lighting import LightMap
from sceneslam.sources.two_rooms.place import SUN, Place
from sceneslam.sources.two_rooms.rays import Hits, RayCaster
from sceneslam.sources.two_rooms.sheet import pack
from sceneslam.sources.two_rooms.surfaces import TEXEL_M
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_LEVELS = 6  # of each texture, every one half as fine as the one before
_SHEET_COLUMNS = 4096
_ROW = 256  # rays of edges are looked up in rows of this many
_EDGE_OFFSETS_PX = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A noise-free frame."""

    image_bgr: Image  # (H, W, 3), 0..255
    depth_m: Image  # (H, W), along the optical axis; inf where nothing is
    cosine: Image  # (H, W), between the ray and the surface's normal
    sunlight: Image | None  # (H, W), irradiance by the sun; None when it does not shine


class Eye:
    """Renders views of one place with one camera."""

    def __init__(self, place: Place, light: LightMap, caster: RayCaster, camera: Camera) -> None:
        self._caster, self._light, self._camera = caster, light, camera
        self._skin, self._skin_lookup = _paint_skin(place)
        normals = np.stack([panel.normal for panel in place.panels])
        self._normals = np.repeat(normals, 2, axis=0).astype(np.float32)  # of triangles
        self._sky = np.sqrt(place.sun.sky) * 255.0 if place.sun else 0.0
        self._directions = _directions(camera, (0.0, 0.0))
        self._lengths = np.linalg.norm(self._directions.reshape(-1, 3), axis=1)
        self._edge_directions = [_directions(camera, offset) for offset in _EDGE_OFFSETS_PX]

    def look(self, T_gt_cam: Transform, levels: Mapping[str, float]) -> View:
        """Return the view from a pose, each group of lamps at its level (0 off, 1 full)."""
        lit = self._lit(levels)
        shaded = self._shade(_rays(T_gt_cam, self._directions), self._lengths, lit, levels)
        self._soften_edges(shaded, T_gt_cam, lit, levels)
        return View(
            image_bgr=np.minimum(shaded.image_bgr, 255.0),
            depth_m=shaded.hits.reach.reshape(shaded.cosine.shape),
            cosine=shaded.cosine,
            sunlight=shaded.sunlight,
        )

    def _lit(self, levels: Mapping[str, float]) -> Image:
        """Return the square root of the light on the sheet of the light map."""
        total = np.zeros_like(self._light.irradiance[0])
        for group, light in zip(self._light.groups, self._light.irradiance, strict=True):
            if levels[group] > 0.0:
                total += np.float32(levels[group]) * light
        return np.asarray(np.sqrt(total))

    def _shade(
        self, rays: Image, lengths: Image, lit: Image, levels: Mapping[str, float]
    ) -> _Shaded:
        """Return what rays (rows, columns, 6), whose ways are so long, show."""
        shape = rays.shape[:2]
        hits = self._caster.first_hits(rays.reshape(-1, 6))
        u, v = np.ascontiguousarray(hits.uv.T)
        way = rays.reshape(-1, 6)[:, 3:]
        cosine = np.abs(np.einsum("ij,ij->i", np.take(self._normals, hits.triangle, 0), way))
        cosine /= lengths
        detail = self._detail(hits.reach, cosine) * len(self._light.lookup) + hits.triangle
        skin = _sample(self._skin, np.take(self._skin_lookup, detail, 0), u, v, shape)
        at = np.take(self._light.lookup, hits.triangle, 0)
        light = _sample(lit, at, u, v, shape)
        image = skin * light
        image[~np.isfinite(hits.reach).reshape(shape)] = self._sky * np.sqrt(levels[SUN])
        sunlight = None
        if levels[SUN] > 0.0:
            sun = self._light.irradiance[self._light.groups.index(SUN), :, :, 1]
            sunlight = levels[SUN] * _sample(sun, at, u, v, shape)
        return _Shaded(
            image_bgr=image,
            hits=hits,
            cosine=cosine.reshape(shape),
            sunlight=sunlight,
        )

    def _detail(self, depth_m: Image, cosine: Image) -> NDArray[np.int64]:
        """Return the level of the textures whose texels are about as large as the pixels."""
        texels = np.minimum(depth_m, 100.0) / (self._camera.fx * TEXEL_M)
        level = np.log2(np.maximum(texels, 1e-3)) - 0.5 * np.log2(np.maximum(cosine, 0.02))
        return np.asarray(np.clip(np.rint(level), 0, _LEVELS - 1), dtype=np.int64)

    def _soften_edges(
        self, shaded: _Shaded, T_gt_cam: Transform, lit: Image, levels: Mapping[str, float]
    ) -> None:
        """Average four rays per pixel, in place, where panels meet."""
        image = shaded.image_bgr
        pixels = np.flatnonzero(_edges((shaded.hits.triangle // 2).reshape(image.shape[:2])))
        if len(pixels) == 0:
            return
        padded = np.resize(pixels, -(-len(pixels) // _ROW) * _ROW)
        squares = np.zeros((len(padded), 3), np.float32)
        for directions in self._edge_directions:
            rays = _rays(T_gt_cam, directions.reshape(-1, 3)[padded]).reshape(-1, _ROW, 6)
            squares += (
                self._shade(rays, self._lengths[padded], lit, levels).image_bgr.reshape(-1, 3) ** 2
            )
        image.reshape(-1, 3)[padded] = np.sqrt(squares / len(self._edge_directions))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shaded:
    image_bgr: Image  # (rows, columns, 3)
    hits: Hits
    cosine: Image  # (rows, columns)
    sunlight: Image | None


def _directions(camera: Camera, offset_px: tuple[float, float]) -> Image:
    """Return the rays' directions (H, W, 3) in `cam`, with z = 1: reach is depth."""
    width, height = camera.size_wh
    x = (np.arange(width) + offset_px[0] - camera.cx) / camera.fx
    y = (np.arange(height) + offset_px[1] - camera.cy) / camera.fy
    directions = np.ones((height, width, 3), np.float32)
    directions[..., 0], directions[..., 1] = x, y[:, None]
    return directions


def _rays(T_gt_cam: Transform, directions_cam: Image) -> Image:
    """Return rays (..., 6) in gt."""
    rays = np.empty((*directions_cam.shape[:-1], 6), np.float32)
    rays[..., :3] = T_gt_cam[:3, 3]
    x, y = directions_cam[..., 0], directions_cam[..., 1]
    for axis, (a, b, c) in enumerate(T_gt_cam[:3, :3].astype(np.float32)):
        rays[..., 3 + axis] = a * x + b * y + c  # by hand: the same bits for any number of threads
    return rays


def _sample(
    sheet: Image | NDArray[np.uint8], at: Image, u: Image, v: Image, shape: tuple[int, int]
) -> Image:
    x = (at[:, 0] + at[:, 1] * u).reshape(shape)
    y = (at[:, 2] + at[:, 3] * v).reshape(shape)
    return np.asarray(cv2.remap(sheet, x, y, cv2.INTER_LINEAR), np.float32)


def _edges(panel: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell of each pixel whether a neighbour shows another panel."""
    edges = np.zeros(panel.shape, np.bool_)
    across, down = panel[:, 1:] != panel[:, :-1], panel[1:] != panel[:-1]
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def _paint_skin(place: Place) -> tuple[NDArray[np.uint8], Image]:
    """Return all textures, at all levels, on one sheet, and its lookup (levels * triangles, 4)."""
    blocks, current = [], [panel.texture for panel in place.panels]
    for _ in range(_LEVELS):
        blocks += current
        current = [_halve(texture) for texture in current]
    sheet = pack(np.array([block.shape[1::-1] for block in blocks]), _SHEET_COLUMNS)
    canvas = np.zeros((*sheet.shape, 3), np.uint8)
    for index, block in enumerate(blocks):
        sheet.paste(canvas, index, block)
    return canvas, sheet.lookup()


def _halve(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size_wh = (max(1, texture.shape[1] // 2), max(1, texture.shape[0] // 2))
    return np.asarray(cv2.resize(texture, size_wh, interpolation=cv2.INTER_AREA), np.uint8)
