"""Normal noise for frames, cut from one long table: to draw it anew is what takes time."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import NDArray

_ENTRIES = 1 << 22  # more than four frames' pixels in colour


class NoiseTable:
    """Standard normal numbers, drawn once; a frame takes them from places of its own."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._normals = rng.standard_normal(_ENTRIES, dtype=np.float32)
        self._normals.flags.writeable = False

    def normals(self, rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return an array of the table, read-only, which begins where `rng` says."""
        count = prod(shape)
        start = int(rng.integers(0, max(_ENTRIES - count, 1)))
        part = self._normals[start : start + count]
        return part.reshape(shape) if len(part) == count else np.resize(part, shape)
