"""The median of the newest values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RecentMedian:
    """Keeps the newest `kept` values of `width` numbers each, in a ring buffer."""

    def __init__(self, kept: int, *, width: int) -> None:
        self._ring = np.zeros((kept, width))
        self._count = 0

    def __len__(self) -> int:
        """Return how many values are kept."""
        return min(self._count, len(self._ring))

    @property
    def median(self) -> NDArray[np.float64]:
        """Return the median (width,) of the kept values; at least one is required."""
        kept = len(self)
        middle = [(kept - 1) // 2, kept // 2]
        values = np.partition(self._ring[:kept], middle, axis=0)  # a third of np.median's time
        return np.asarray(0.5 * (values[middle[0]] + values[middle[1]]))

    def add(self, value: NDArray[np.float64] | float) -> None:
        """Add a value (width,)."""
        self._ring[self._count % len(self._ring)] = value
        self._count += 1
