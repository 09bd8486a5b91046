"""Textures (rows, columns, 3) with visual features: paintings, posters, book spines, pin boards."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sceneslam.sources.simulator.places.surfaces import (
    TEXEL_M,
    Colour,
    Material,
    Texture,
    clouds,
    finish,
    noise,
    texels,
    write_lines,
)

_BINDINGS = (
    (62, 56, 150),
    (150, 110, 70),
    (96, 132, 96),
    (190, 200, 205),
    (120, 178, 205),
    (62, 66, 72),
)


def painting(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a framed abstract painting: brush strokes and shapes."""
    rows, columns = shape = texels(width_m, height_m)
    low, high = rng.uniform(40, 150, 3), rng.uniform(110, 235, 3)
    blend = 1.0 / (1.0 + np.exp(-2.0 * clouds(rng, shape, 40.0)))
    image = (low + (high - low) * blend[..., None]).astype(np.float32)
    for _ in range(int(rng.integers(25, 45))):
        _shape(rng, image, shape)
    for _ in range(int(rng.integers(12, 25))):
        points = np.cumsum(rng.normal(0, max(rows, columns) / 14, (6, 2)), axis=0)
        points += rng.uniform((0, 0), (columns, rows))
        line = points.astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [line], False, rng.uniform(20, 240, 3).tolist(), 2)
    return _framed(finish(image, noise(rng, shape, (2.5, 2.5)), 7.0), (30, 34, 40))


def poster(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a printed sheet: a heading, a picture and columns of small print."""
    rows, columns = shape = texels(width_m, height_m)
    paper = rng.uniform((170, 180, 185), (225, 228, 230))
    image = finish(paper, noise(rng, shape, (60, 60)), 1.0)
    ink: Colour = (
        int(rng.integers(20, 110)),
        int(rng.integers(20, 90)),
        int(rng.integers(20, 120)),
    )
    heading = "".join(rng.choice(list("ABDEGKMNRSTXZ2378"), 6))
    scale = columns / 130.0
    cv2.putText(image, heading, (6, int(24 * scale) + 4), 0, scale, ink, max(1, int(2 * scale)))
    top = int(30 * scale) + 8
    inset = painting(rng, width_m * 0.86, (rows - top) * 0.55 * TEXEL_M)
    left = (columns - inset.shape[1]) // 2
    bottom = min(rows, top + inset.shape[0])
    image[top:bottom, left : left + inset.shape[1]] = inset[: bottom - top]
    page = image[bottom + 6 : rows - 6, 8 : columns - 8]
    for half in (page[:, : page.shape[1] // 2 - 4], page[:, page.shape[1] // 2 + 4 :]):
        write_lines(rng, half, ink)
    return image


def spines(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a row of book spines, 1.5 to 5 cm thick, with titles."""
    rows, columns = shape = texels(width_m, height_m)
    image = np.empty((rows, columns, 3), np.uint8)
    left = 0
    while left < columns:
        right = min(columns, left + int(rng.integers(3, 11)))
        base = rng.choice(
            [(40, 36, 110), (96, 64, 36), (60, 92, 60), (190, 200, 205), (38, 40, 44)]
        )
        tone = np.clip(np.asarray(base, float) + rng.normal(0, 22, 3), 15, 235)
        image[:, left:right] = tone
        band = sorted(rng.integers(2, rows - 2, 2))
        image[band[0] : band[1] : 4, left + 1 : right - 1] = 250 - tone
        image[:, left] = tone * 0.4
        left = right
    return finish(image.astype(np.float32), noise(rng, shape, (2, 6)), 4.0)


def pin_board(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a cork board with notes and snapshots pinned on it at odd angles."""
    rows, columns = shape = texels(width_m, height_m)
    image = finish((98, 138, 172), noise(rng, shape, (1.6, 1.6)), 16.0)
    for _ in range(int(rng.integers(10, 16))):
        note = _note(rng)
        high, wide = note.shape[:2]
        turn = cv2.getRotationMatrix2D((wide / 2, high / 2), float(rng.uniform(-14, 14)), 1.0)
        shift = rng.uniform((4, 4), (columns - wide - 4, rows - high - 4))
        turn[:, 2] = turn[:, 2] + shift
        size_wh = (columns, rows)
        mask = cv2.warpAffine(np.full((high, wide), 255, np.uint8), turn, size_wh)
        image[mask > 127] = cv2.warpAffine(note, turn, size_wh, borderMode=cv2.BORDER_REPLICATE)[
            mask > 127
        ]
    return _framed(image, (60, 90, 120))


def decorated(base: Material, *pieces: tuple[float, float, float, float, Material]) -> Material:
    """Return a surface with pieces, each (left, top, width, height) [m] and its material."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        image = base(rng, width_m, height_m)
        for left_m, top_m, piece_width_m, piece_height_m, piece in pieces:
            texture = piece(rng, piece_width_m, piece_height_m)
            top, left = round(top_m / TEXEL_M), round(left_m / TEXEL_M)
            area = image[top : top + texture.shape[0], left : left + texture.shape[1]]
            area[:] = texture[: area.shape[0], : area.shape[1]]
        return image

    return material


def _shape(rng: np.random.Generator, image: NDArray[np.float32], shape: tuple[int, int]) -> None:
    """Paint one ellipse or polygon, in place."""
    rows, columns = shape
    colour = rng.uniform(20, 240, 3).tolist()
    centre = rng.uniform((0, 0), (columns, rows))
    size = rng.uniform(0.03, 0.16) * max(rows, columns)
    if rng.random() < 0.5:
        axes = (int(size) + 1, int(size * rng.uniform(0.3, 1.0)) + 1)
        at = (int(centre[0]), int(centre[1]))
        cv2.ellipse(image, at, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1)
        return
    angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 7))))
    corners = centre + size * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    cv2.fillPoly(image, [corners.astype(np.int32).reshape(-1, 1, 2)], colour)


def _note(rng: np.random.Generator) -> Texture:
    if rng.random() < 0.4:
        return painting(rng, rng.uniform(0.1, 0.18), rng.uniform(0.08, 0.16))
    page = np.empty((*texels(rng.uniform(0.08, 0.2), rng.uniform(0.08, 0.22)), 3), np.uint8)
    page[:] = rng.uniform((120, 180, 190), (225, 230, 235))
    write_lines(rng, page, (60, 50, 45))
    return page


def _framed(image: Texture, colour: Colour) -> Texture:
    width = max(2, round(0.02 / TEXEL_M))
    for side in (image[:width], image[-width:], image[:, :width], image[:, -width:]):
        side[:] = colour
    return image
