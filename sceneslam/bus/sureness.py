"""Whether a module is as sure of its pose as it usually is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.recent import RecentMedian

_UNUSUAL = 2.0  # times the usual standard deviation
_KEPT = 300  # poses that tell what is usual: 10 s at 30 Hz, longer than it takes to reach a wall


class Sureness:
    """Follows the standard deviations of a module's poses; their median is usual.

    A module seldom says that it tracks and is lost at the next image: before that its covariance
    grows, and its poses are worse than it is worth starting another module from.
    """

    def __init__(self) -> None:
        self._deviations = RecentMedian(_KEPT, width=2)  # of position [m] and rotation [rad]

    def is_usual(self, covariance: NDArray[np.float64] | None) -> bool:
        """Tell whether a pose's (6, 6) covariance is nothing unusual; unknown ones are not."""
        if covariance is None:
            return True
        variances = covariance.diagonal()
        now = np.sqrt([variances[:3].sum(), variances[3:].sum()])
        self._deviations.add(now)
        return bool((now <= _UNUSUAL * self._deviations.median).all())
