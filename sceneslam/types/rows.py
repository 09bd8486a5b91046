"""Rows of numbers that grow, without an object for each: a run has some 100,000 poses an hour."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_BLOCK = 256  # rows that are allocated at a time


class Rows:
    """A growing array (N, *shape) of float64."""

    def __init__(self, *shape: int) -> None:
        self._shape, self._count = shape, 0
        self._blocks: list[NDArray[np.float64]] = []

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> NDArray[np.float64]:
        """Return a copy of one row."""
        row = range(self._count)[index]
        return np.array(self._blocks[row // _BLOCK][row % _BLOCK])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return a copy of all rows (N, *shape)."""
        rows = np.concatenate([np.empty((0, *self._shape)), *self._blocks])[: self._count]
        return rows if dtype is None else rows.astype(dtype)

    def append(self, row: NDArray[np.float64]) -> None:
        """Add a row of the shape."""
        block, at = divmod(self._count, _BLOCK)
        if block == len(self._blocks):
            self._blocks.append(np.empty((_BLOCK, *self._shape)))
        self._blocks[block][at] = row
        self._count += 1

    def cut(self, count: int) -> None:
        """Keep the first `count` rows."""
        self._count = min(count, self._count)
        del self._blocks[-(-self._count // _BLOCK) :]
