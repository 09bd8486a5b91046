"""Estimate the systematic error of the wheels' distance; tyre sizes are known to a few per cent.

The scale alone of Censi, Franchi, Marchionni and Oriolo, "Simultaneous calibration of odometry and
sensor parameters for mobile robots", T-RO 2013.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

_OUTLIER = 3.0  # standard deviations: larger errors do not come from the tyres


@dataclass(slots=True)
class DistanceError:
    """A Kalman filter of the wheels' distance error per metre of odometry."""

    deviation: float  # standard deviation before the first measurement
    drift: float  # standard deviation of the change from one measurement to the next: tyres wear
    ratio: float = field(default=0.0, init=False)
    variance: float = field(init=False)

    def __post_init__(self) -> None:
        self.variance = self.deviation**2

    def learn(self, missed_m: float, forward_m: float, variance_m2: float) -> None:
        """Update by the error of the wheels' `forward_m` against a measured distance.

        `missed_m` is that error, `variance_m2` the variance of its measurement.
        """
        self.variance += self.drift**2
        innovation_m2 = self.variance * forward_m**2 + variance_m2
        limit_m = _OUTLIER * math.sqrt(innovation_m2)
        gain = self.variance * forward_m / innovation_m2
        self.ratio += gain * min(max(missed_m, -limit_m), limit_m)
        self.variance *= 1.0 - gain * forward_m
