"""Textures of walls, floors and furniture, with random irregularities of colour.

A texture is (rows, columns, 3) uint8 BGR, row 0 at the top, with texels `TEXEL_M` wide. Values are
255 * sqrt(reflectance), the camera's response: its image in unit light equals the texture.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

TEXEL_M = 0.005

Texture = NDArray[np.uint8]
Colour = tuple[int, int, int]  # BGR
Material = Callable[[np.random.Generator, float, float], Texture]  # of (rng, width_m, height_m)
Field = NDArray[np.float32]

WHITE: Colour = (196, 206, 210)
OAK: Colour = (104, 148, 184)
BIRCH: Colour = (140, 176, 200)
WALNUT: Colour = (66, 92, 122)


def texels(width_m: float, height_m: float) -> tuple[int, int]:
    """Return (rows, columns) of a texture."""
    return max(4, round(height_m / TEXEL_M)), max(4, round(width_m / TEXEL_M))


def noise(rng: np.random.Generator, shape: tuple[int, int], cell_wh: tuple[float, float]) -> Field:
    """Return smooth noise (rows, columns) of unit variance and correlation length `cell_wh`."""
    rows, columns = shape
    coarse = (max(2, round(rows / cell_wh[1]) + 1), max(2, round(columns / cell_wh[0]) + 1))
    values = rng.standard_normal(coarse, dtype=np.float32)
    return _field(cv2.resize(values, (columns, rows), interpolation=cv2.INTER_CUBIC))


def clouds(rng: np.random.Generator, shape: tuple[int, int], cell_px: float) -> Field:
    """Return noise (rows, columns) at four scales, the coarsest of `cell_px` texels."""
    octaves = [0.5**k * noise(rng, shape, (cell_px / 2**k,) * 2) for k in range(4)]
    return _field(sum(octaves[1:], octaves[0]))


def finish(colour: NDArray[np.floating] | Colour, shade: Field, gain: float = 1.0) -> Texture:
    """Return a colour (3,) or (rows, columns, 3) plus `gain` * `shade` grey levels."""
    base = np.asarray(colour, dtype=np.float32)
    return np.clip(base + gain * shade[..., None] + 0.5, 4, 250).astype(np.uint8)


def paint(colour: Colour) -> Material:
    """Return painted plaster: uniform, with a grain of half a grey level."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        shape = texels(width_m, height_m)
        return finish(colour, rng.standard_normal(shape, dtype=np.float32), 0.6)

    return material


def plain(colour: Colour) -> Material:
    """Return a ceiling's paint: one colour, in few texels."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        return np.full((4, 4, 3), colour, np.uint8)

    return material


def brick(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a wall of bricks of different colour with light joints."""
    rows, columns = shape = texels(width_m, height_m)
    high, wide = round(0.08 / TEXEL_M), round(0.25 / TEXEL_M)
    y, x = np.arange(rows) // high, np.arange(columns)
    shifted = (x[None] + (y % 2)[:, None] * (wide // 2)) // wide
    tone = rng.normal(0.0, 14.0, (y[-1] + 1, shifted.max() + 1)).astype(np.float32)
    shade = tone[y[:, None], shifted] + 5.0 * rng.standard_normal(shape, dtype=np.float32)
    image = finish((104, 120, 158), shade)
    image[np.arange(rows) % high < 2] = (150, 158, 164)
    image[((x[None] + (y % 2)[:, None] * (wide // 2)) % wide) < 2] = (150, 158, 164)
    return image


def stone_tiles(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return polished stone tiles, 60 cm wide, in texels twice as wide as elsewhere."""
    rows, columns = shape = texels(width_m / 2, height_m / 2)
    size = round(0.3 / TEXEL_M)
    tone = rng.normal(0.0, 9.0, (rows // size + 1, columns // size + 1)).astype(np.float32)
    tiles = np.kron(tone, np.ones((size, size), np.float32))[:rows, :columns]
    shade = _field(tiles + 7.0 * clouds(rng, shape, 40.0) + 4.0 * noise(rng, shape, (2.0, 2.0)))
    image = finish((132, 140, 146), shade)
    image[::size] = (70, 74, 78)
    image[:, ::size] = (70, 74, 78)
    return image


def wood(colour: Colour, contrast: float = 1.0) -> Material:
    """Return planed wood with grain along the longer side."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        if height_m > width_m:
            return np.ascontiguousarray(material(rng, height_m, width_m).transpose(1, 0, 2))
        return finish(colour, _grain(rng, texels(width_m, height_m)), contrast)

    return material


def floorboards(colour: Colour) -> Material:
    """Return a floor of boards 12 cm wide, of different colour, with dark joints and knots."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        rows, columns = texels(width_m, height_m)
        image = np.empty((rows, columns, 3), np.float32)
        board = round(0.12 / TEXEL_M)
        for top in range(0, rows, board):  # boards, not texels
            strip = image[top : top + board]
            _lay_boards(rng, strip, colour)
            strip[0] *= 0.55
        return np.clip(image, 4, 250).astype(np.uint8)

    return material


def fabric(colour: Colour, contrast: float = 9.0) -> Material:
    """Return woven cloth with folds and worn areas."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        shape = texels(width_m, height_m)
        weave = noise(rng, shape, (1.6, 1.6)) + 1.2 * clouds(rng, shape, 30.0)
        return finish(colour, weave, contrast)

    return material


def cardboard(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return the side of a parcel: flutes, a strip of tape, a label and a stamp."""
    rows, columns = shape = texels(width_m, height_m)
    image = finish((112, 150, 182), clouds(rng, shape, 25.0) + noise(rng, shape, (1.5, 80)), 4.0)
    tape = round(0.025 / TEXEL_M)
    middle = columns // 2 + int(rng.integers(-3, 4))
    image[:, middle - tape : middle + tape] = (120, 176, 205)
    if min(rows, columns) < 40:
        return image
    high, wide = int(rows * rng.uniform(0.2, 0.35)), int(columns * rng.uniform(0.25, 0.4))
    top, left = int(rng.integers(3, rows - high - 2)), int(rng.integers(3, columns - wide - 2))
    image[top : top + high, left : left + wide] = 225
    write_lines(rng, image[top : top + high, left : left + wide], (40, 40, 45))
    mark = (int(rng.integers(8, columns - 8)), int(rng.integers(8, rows - 8)))
    cv2.putText(image, "UP" if rng.random() < 0.5 else "Z7", mark, 0, 0.5, (50, 60, 90), 2)
    return image


def rug(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a hand-knotted rug: a border and a field of irregular medallions."""
    rows, columns = shape = texels(width_m, height_m)
    palette = np.array([(84, 76, 146), (140, 112, 86), (168, 192, 206), (70, 92, 118)], np.float32)
    tone = np.digitize(clouds(rng, shape, 26.0), [-0.7, 0.1, 0.8])
    image = palette[tone]
    for inset, index in ((0, 3), (8, 2), (16, 0), (30, 3)):
        box = (slice(inset, rows - inset), slice(inset, columns - inset))
        frame = np.ones(shape, bool)
        frame[inset + 7 : rows - inset - 7, inset + 7 : columns - inset - 7] = False
        image[box][frame[box]] = palette[index]
    for _ in range(60):
        centre = (int(rng.integers(40, columns - 40)), int(rng.integers(40, rows - 40)))
        axes = (int(rng.integers(4, 22)), int(rng.integers(4, 22)))
        shade = palette[int(rng.integers(4))] * rng.uniform(0.7, 1.2)
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360, shade.tolist(), -1)
    return finish(image, noise(rng, shape, (1.5, 1.5)), 8.0)


def leaf(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return a leaf's green with lighter veins."""
    rows, columns = shape = texels(width_m, height_m)
    image = finish((58, 118, 84), clouds(rng, shape, 10.0), 14.0)
    image[:, columns // 2] = (96, 168, 140)
    image[:: max(4, rows // 6)] = np.clip(image[:: max(4, rows // 6)] * 1.25, 0, 250)
    return image


def carpet_tiles(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return an office floor of mottled tiles, 50 cm wide."""
    rows, columns = shape = texels(width_m, height_m)
    mottle = noise(rng, shape, (2.0, 2.0)) + 1.5 * clouds(rng, shape, 12.0)
    size = round(0.5 / TEXEL_M)
    tone = rng.normal(0.0, 5.0, (rows // size + 1, columns // size + 1)).astype(np.float32)
    tiles = np.kron(tone, np.ones((size, size), np.float32))[:rows, :columns]
    shade = _field(tiles + 11.0 * mottle)
    return finish((112, 112, 108), shade)


def slats(colour: Colour) -> Material:
    """Return a lowered blind: slats 5 cm high."""

    def material(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
        rows, columns = texels(width_m, height_m)
        phase = (np.arange(rows, dtype=np.float32) % 10.0) / 10.0
        shade = np.repeat((18.0 * (0.6 - phase))[:, None], columns, axis=1)
        return finish(colour, _field(shade) + rng.standard_normal((rows, columns), np.float32))

    return material


def write_lines(rng: np.random.Generator, page: Texture, ink: Colour) -> None:
    """Write illegible lines of print onto a page (rows, columns, 3), in place."""
    rows, columns = page.shape[:2]
    step = max(4, rows // 9)
    for row in range(2, rows - 3, step):  # lines of print
        words = np.cumsum(rng.integers(3, 11, 2 + columns // 4))
        for left, right in zip(words[:-1:2], words[1::2], strict=False):
            if right < columns - 2:
                page[row : row + max(2, step // 2), left:right] = ink


def _grain(rng: np.random.Generator, shape: tuple[int, int]) -> Field:
    """Return the streaks of wood, along the columns, warped around a knot or two."""
    rows, columns = shape
    streaks = 5.0 * noise(rng, shape, (90, 2.2)) + 4.0 * noise(rng, shape, (160, 9))
    streaks += 3.0 * noise(rng, shape, (24, 1.2))
    for _ in range(rng.poisson(rows * columns * TEXEL_M**2 * 1.5)):
        centre = (int(rng.integers(columns)), int(rng.integers(rows)))
        cv2.ellipse(streaks, centre, (int(rng.integers(2, 5)), 2), 0, 0, 360, -28.0, -1)
    return streaks


def _lay_boards(rng: np.random.Generator, strip: NDArray[np.float32], colour: Colour) -> None:
    """Fill a strip, in place, with boards 0.6 to 1.6 m long."""
    columns = strip.shape[1]
    left = -int(rng.integers(0, 200))
    while left < columns:
        right = left + int(rng.integers(round(0.6 / TEXEL_M), round(1.6 / TEXEL_M)))
        part = strip[:, max(left, 0) : min(right, columns)]
        if part.shape[1] > 0:
            tone = np.asarray(colour, np.float32) * np.float32(rng.uniform(0.8, 1.12))
            part[:] = tone + 1.2 * _grain(rng, (part.shape[0], part.shape[1]))[..., None]
            part[:, 0] *= 0.5
        left = right


def _field(values: object) -> Field:
    return np.asarray(values, dtype=np.float32)
