"""Whether a module is as sure of its pose as it usually is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_UNUSUAL = 3.0  # times the usual standard deviation
_GAIN = 0.02  # of the newest in what is usual


class Sureness:
    """Follows the standard deviations of a module's poses.

    A module seldom says that it tracks and is lost at the next image: before that its covariance
    grows, and its poses are worse than it is worth starting another module from.
    """

    def __init__(self) -> None:
        self._usual: NDArray[np.float64] | None = None  # position [m], rotation [rad]

    def is_usual(self, covariance: NDArray[np.float64] | None) -> bool:
        """Tell whether a pose's (6, 6) covariance is nothing unusual; unknown ones are not."""
        if covariance is None:
            return True
        variances = covariance.diagonal()
        deviations = np.sqrt([variances[:3].sum(), variances[3:].sum()])
        if self._usual is None:
            self._usual = deviations
        limits = _UNUSUAL * self._usual
        # What lasts becomes usual: a module may be surer at its first pose than ever after.
        self._usual = self._usual + _GAIN * (np.minimum(deviations, limits) - self._usual)
        return bool((deviations <= limits).all())
