"""Noise-free camera images of a place: colour, depth and the surfaces' angles of incidence.

Ray casting finds the panel that a pixel shows: on a coarse grid, and between grid nodes that show
different panels. Depth and texture coordinates then follow exactly from the panel's plane.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.optics.lighting import LightMap
from sceneslam.sources.simulator.optics.planes import Planes, Sight
from sceneslam.sources.simulator.optics.rays import RayCaster
from sceneslam.sources.simulator.optics.sheet import pack
from sceneslam.sources.simulator.places.place import SUN, SimulatedPlace
from sceneslam.sources.simulator.places.surfaces import TEXEL_M
from sceneslam.types.rig import Camera
from sceneslam.types.se3 import Transform

_LEVELS = 6  # mipmap levels of each texture, each half the resolution of the previous
_SHEET_COLUMNS = 4096
_ROW = 256  # samples at edges are processed in rows of this length
_STEP_PX = 2  # of the coarse grid; thinner objects may be missed
_EDGE_OFFSETS_PX = ((-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375))
_EDGE_CONTRAST = 6.0  # grey values at nominal exposure; lower contrast is below noise

Image = NDArray[np.float32]
Panels = NDArray[np.int32]  # panel index per pixel; the number of panels: sky


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderedView:
    """A noise-free image with depth."""

    image_bgr: Image  # (H, W, 3), 255 for white in unit light; the square root of radiance
    depth_m: Image  # (H, W), along the optical axis; inf where nothing is
    cosine: Image  # (H, W), of the angle between ray and surface normal
    blinded: NDArray[np.bool_]  # (H, W), no depth because of sunlight or a polished surface


class CameraRenderer:
    """Renders views of one place with one camera."""

    def __init__(
        self, place: SimulatedPlace, light: LightMap, caster: RayCaster, camera: Camera
    ) -> None:
        self._caster, self._light, self._camera = caster, light, camera
        self._planes = Planes(place.panels)
        self._skin, self._skin_lookup = _paint_skin(place)
        self._light_lookup = _with_sky(light.lookup[::2])  # of each panel's first triangle
        self._polished = np.array([*(panel.is_polished for panel in place.panels), False])
        self._sun = place.sun
        self._sky_level = np.sqrt(place.sun.sky) * 255.0 if place.sun else 0.0
        self._directions = _directions(camera, (0.0, 0.0))
        self._lengths = np.linalg.norm(self._directions, axis=2)
        self._edge_directions = [_directions(camera, offset) for offset in _EDGE_OFFSETS_PX]
        self._lit_at: tuple[float, ...] = ()
        self._lit_sheet = np.zeros((1, 1, 4), np.float32)

    @property
    def directions(self) -> Image:
        """Return the directions (H, W, 3) of the pixels' rays in `cam`, with z = 1."""
        return self._directions

    def look(self, T_gt_cam: Transform, levels: Mapping[str, float]) -> RenderedView:
        """Return the view from the pose T_gt_cam (4, 4) [m], with lamp groups at levels 0 to 1."""
        panels = self._find_panels(T_gt_cam)
        sight = self._planes.seen_from(T_gt_cam)
        shaded = self._shade(sight, panels, self._directions, self._lengths, levels)
        self._soften_edges(shaded.image_bgr, panels, T_gt_cam, sight, levels)
        blinded = np.take(self._polished, panels)
        if shaded.sunlight is not None and self._sun is not None:
            blinded |= shaded.sunlight >= self._sun.blinding
        return RenderedView(
            image_bgr=shaded.image_bgr,
            depth_m=shaded.depth_m,
            cosine=shaded.cosine,
            blinded=blinded,
        )

    def meter(self, T_gt_cam: Transform, levels: Mapping[str, float], step_px: int) -> Image:
        """Return the grey values (N,), 0 to 255, of every `step_px`-th pixel."""
        directions = np.ascontiguousarray(self._directions[::step_px, ::step_px])
        lengths = np.ascontiguousarray(self._lengths[::step_px, ::step_px])
        panels, sight = self._cast(T_gt_cam, directions), self._planes.seen_from(T_gt_cam)
        image = self._shade(sight, panels, directions, lengths, levels).image_bgr
        return np.asarray(image @ np.array([0.114, 0.587, 0.299], np.float32)).ravel()

    def _cast(self, T_gt_cam: Transform, directions_cam: Image) -> Panels:
        rays = _rays(T_gt_cam, directions_cam)
        return self._caster.first_panels(rays.reshape(-1, 6)).reshape(rays.shape[:-1])

    def _find_panels(self, T_gt_cam: Transform) -> Panels:
        """Return each pixel's panel; between equal grid nodes, it is that of the nodes."""
        step, (width, height) = _STEP_PX, self._camera.size_wh
        nodes = self._cast(T_gt_cam, np.ascontiguousarray(self._directions[::step, ::step]))
        corners = [nodes, _moved(nodes, 0, 1), _moved(nodes, 1, 0), _moved(nodes, 1, 1)]
        agreed = np.logical_and.reduce([corners[0] == corner for corner in corners[1:]])
        panels = np.repeat(np.repeat(nodes, step, axis=0), step, axis=1)[:height, :width]
        unsure = np.repeat(np.repeat(~agreed, step, axis=0), step, axis=1)[:height, :width]
        unsure[::step, ::step] = False
        at = np.flatnonzero(unsure)
        panels.reshape(-1)[at] = self._cast(T_gt_cam, self._directions.reshape(-1, 3)[at])
        return panels

    def _lit(self, levels: Mapping[str, float]) -> Image:
        """Return the light map's sheet: square root of the light (BGR), and the sun's share."""
        wanted = tuple(levels[group] for group in self._light.groups)
        if wanted != self._lit_at:
            total = np.zeros_like(self._light.irradiance[0])
            sun = np.zeros(total.shape[:2], np.float32)
            for group, light in zip(self._light.groups, self._light.irradiance, strict=True):
                if levels[group] > 0.0:
                    total += np.float32(levels[group]) * light
                if group == SUN:
                    sun = np.float32(levels[group]) * light[..., 1]
            self._lit_at, self._lit_sheet = wanted, np.dstack([np.sqrt(total), sun])
        return self._lit_sheet

    def _shade(
        self,
        sight: Sight,
        panels: Panels,
        directions: Image,
        lengths: Image,
        levels: Mapping[str, float],
    ) -> _Shaded:
        """Return colour and depth of pixels (rows, columns)."""
        seen = sight.at(panels, directions)
        cosine = seen.slope / lengths
        detail = self._detail(seen.depth_m, cosine) * (self._planes.count + 1) + panels
        image = _sample(self._skin, self._skin_lookup, detail, seen.u, seen.v)
        light = _sample(self._lit(levels), self._light_lookup, panels, seen.u, seen.v)
        image *= light[..., :3]
        sky = panels == self._planes.count
        has_sun = levels.get(SUN, 0.0) > 0.0
        image[sky] = self._sky_level * np.sqrt(levels.get(SUN, 0.0))
        seen.depth_m[sky] = np.inf
        return _Shaded(
            image_bgr=image,
            depth_m=seen.depth_m,
            cosine=cosine,
            sunlight=light[..., 3] if has_sun else None,
        )

    def _detail(self, depth_m: Image, cosine: Image) -> NDArray[np.int32]:
        """Return the mipmap level whose texels are about as large as the pixels."""
        texels = np.minimum(depth_m, np.float32(100.0)) / np.float32(self._camera.fx * TEXEL_M)
        square = texels * texels / np.maximum(cosine, np.float32(0.02))
        level = 0.5 * np.log2(np.maximum(square, np.float32(1.0)))
        return np.minimum(np.rint(level), _LEVELS - 1).astype(np.int32)

    def _soften_edges(
        self,
        image: Image,
        panels: Panels,
        T_gt_cam: Transform,
        sight: Sight,
        levels: Mapping[str, float],
    ) -> None:
        """Average four samples per pixel, in place, at edges between panels of different colour."""
        pixels = np.flatnonzero(_edges(panels, image))
        if len(pixels) == 0:
            return
        padded = np.resize(pixels, -(-len(pixels) // _ROW) * _ROW)
        lengths = self._lengths.reshape(-1)[padded].reshape(-1, _ROW)
        squares = np.zeros((len(padded), 3), np.float32)
        for directions in self._edge_directions:
            samples = directions.reshape(-1, 3)[padded].reshape(-1, _ROW, 3)
            hit = self._cast(T_gt_cam, samples)
            shaded = self._shade(sight, hit, samples, lengths, levels).image_bgr
            squares += shaded.reshape(-1, 3) ** 2
        image.reshape(-1, 3)[padded] = np.sqrt(squares / len(self._edge_directions))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shaded:
    image_bgr: Image  # (rows, columns, 3)
    depth_m: Image  # (rows, columns)
    cosine: Image
    sunlight: Image | None


def _directions(camera: Camera, offset_px: tuple[float, float]) -> Image:
    """Return ray directions (H, W, 3) in `cam`, with z = 1: then the ray length is the depth."""
    width, height = camera.size_wh
    x = (np.arange(width) + offset_px[0] - camera.cx) / camera.fx
    y = (np.arange(height) + offset_px[1] - camera.cy) / camera.fy
    directions = np.ones((height, width, 3), np.float32)
    directions[..., 0], directions[..., 1] = x, y[:, None]
    return directions


def _rays(T_gt_cam: Transform, directions_cam: Image) -> Image:
    """Return rays (..., 6), origin [m] and direction, in `gt`."""
    rays = np.empty((*directions_cam.shape[:-1], 6), np.float32)
    rays[..., :3] = T_gt_cam[:3, 3]
    x, y = directions_cam[..., 0], directions_cam[..., 1]
    for axis, (a, b, c) in enumerate(T_gt_cam[:3, :3].astype(np.float32)):
        rays[..., 3 + axis] = a * x + b * y + c  # same result for any number of threads
    return rays


def _sample(
    sheet: Image | NDArray[np.uint8], lookup: Image, index: NDArray[np.int32], u: Image, v: Image
) -> Image:
    """Return the sheet's values (rows, columns, C) at texture coordinates in blocks."""
    left, across, top, down = (np.take(column, index) for column in lookup)
    across *= u
    across += left
    down *= v
    down += top
    return np.asarray(cv2.remap(sheet, across, down, cv2.INTER_LINEAR), np.float32)


def _moved(nodes: Panels, down: int, right: int) -> Panels:
    """Return each node's neighbour; at the border an invalid index, so that rays are cast there."""
    moved = np.full_like(nodes, -1)
    moved[: len(nodes) - down, : nodes.shape[1] - right] = nodes[down:, right:]
    return moved


def _edges(panels: Panels, image: Image) -> NDArray[np.bool_]:
    """Return (H, W) whether a neighbouring pixel shows another panel of another colour."""
    edges = np.zeros(panels.shape, np.bool_)
    green = np.ascontiguousarray(image[..., 1])
    for here, there in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        across = panels[here] != panels[there]
        across &= np.abs(green[here] - green[there]) > _EDGE_CONTRAST
        edges[here] |= across
        edges[there] |= across
    return edges


def _with_sky(lookup: Image) -> Image:
    """Return (4, N + 1) of a look-up (N, 4); the sky uses the first block."""
    return np.ascontiguousarray(np.concatenate([lookup, lookup[:1]]).T)


def _paint_skin(place: SimulatedPlace) -> tuple[NDArray[np.uint8], Image]:
    """Return one sheet of all textures at all levels and its look-up (4, levels * panels)."""
    blocks, current = [], [panel.texture for panel in place.panels]
    for _ in range(_LEVELS):
        blocks += current
        current = [_halve(texture) for texture in current]
    sheet = pack(np.array([block.shape[1::-1] for block in blocks]), _SHEET_COLUMNS)
    canvas = np.zeros((*sheet.shape, 3), np.uint8)
    for index, block in enumerate(blocks):
        sheet.paste(canvas, index, block)
    levels = np.split(sheet.lookup()[::2], _LEVELS)
    return canvas, np.concatenate([_with_sky(level) for level in levels], axis=1)


def _halve(texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size_wh = (max(1, texture.shape[1] // 2), max(1, texture.shape[0] // 2))
    return np.asarray(cv2.resize(texture, size_wh, interpolation=cv2.INTER_AREA), np.uint8)
