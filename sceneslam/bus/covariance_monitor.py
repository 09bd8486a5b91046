"""Check whether the covariance of a module's pose is larger than usual."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.recent import RecentMedian

_UNUSUAL = 2.0  # times the usual standard deviation
_KEPT = 300  # poses in the median: 10 s at 30 Hz, longer than it takes to reach a wall


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
