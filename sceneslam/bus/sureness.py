"""Whether a module is as sure of its pose as it usually is."""

from __future__ import annotations

import math

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
        self._usual: tuple[float, float] | None = None  # position [m], rotation [rad]

    def is_usual(self, covariance: NDArray[np.float64] | None) -> bool:
        """Tell whether a pose's (6, 6) covariance is nothing unusual; unknown ones are not."""
        if covariance is None:
            return True
        variances = covariance.diagonal().tolist()
        deviations = (math.sqrt(sum(variances[:3])), math.sqrt(sum(variances[3:])))
        usual = self._usual or deviations
        # What lasts becomes usual: a module may be surer at its first pose than ever after.
        self._usual = (_follow(usual[0], deviations[0]), _follow(usual[1], deviations[1]))
        return all(now <= _UNUSUAL * then for now, then in zip(deviations, usual, strict=True))


def _follow(usual: float, now: float) -> float:
    return usual + _GAIN * (min(now, _UNUSUAL * usual) - usual)
