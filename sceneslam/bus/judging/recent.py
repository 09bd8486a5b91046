"""The median of the newest values; whether a covariance is larger than usual, by that median."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Times the usual standard deviation. white_wall, five seeds: 0.31 cm at 1.5, 0.30 at 2, 0.46 at 3.
_UNUSUAL = 2.0
_KEPT = 300  # poses in the median: 10 s at 30 Hz, longer than it takes to reach a wall


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


class CovarianceMonitor:
    """Follows the standard deviations of a module's poses; their median is the usual value.

    A module is seldom lost from one image to the next: its covariance grows before, and its poses
    become too inaccurate to start another module from.
    """

    def __init__(self) -> None:
        self._deviations = RecentMedian(_KEPT, width=2)  # of position [m] and rotation [rad]

    def is_usual(self, covariance: NDArray[np.float64] | None) -> bool:
        """Tell whether a pose's (6, 6) covariance is within the usual range, or unknown."""
        if covariance is None:
            return True
        variances = covariance.diagonal()
        now = np.sqrt([variances[:3].sum(), variances[3:].sum()])
        self._deviations.add(now)
        return bool((now <= _UNUSUAL * self._deviations.median).all())
