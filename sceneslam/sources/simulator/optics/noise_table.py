"""Normal noise for frames, taken from one long table, as drawing it for each frame is slow."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import NDArray

_ENTRIES = 1 << 22  # more than four frames' pixels in colour


class NoiseTable:
    """Standard normal numbers, drawn once; each frame takes a random part of them."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._normals = rng.standard_normal(_ENTRIES, dtype=np.float32)
        self._normals.flags.writeable = False

    def normals(self, rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return a read-only array (...) of `shape` from a random position of the table."""
        count = prod(shape)
        start = int(rng.integers(0, max(_ENTRIES - count, 1)))
        part = self._normals[start : start + count]
        return part.reshape(shape) if len(part) == count else np.resize(part, shape)
