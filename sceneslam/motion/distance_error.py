"""Estimate the systematic errors of the wheels' distances.

Tyre sizes are known to a few per cent; a base that is not above the axle is moved sideways by a
turn. The scale and the sensor's position of Censi, Franchi, Marchionni and Oriolo, "Simultaneous
calibration of odometry and sensor parameters for mobile robots", T-RO 2013, each by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

OUTLIER = 3.0  # standard deviations: larger errors are not systematic


@dataclass(slots=True)
class DistanceError:
    """A Kalman filter of an error of the wheels' distance per metre, or radian, of odometry."""

    deviation: float  # standard deviation before the first measurement
    drift: float  # standard deviation of the change from one measurement to the next: tyres wear
    ratio: float = field(default=0.0, init=False)
    variance: float = field(init=False)

    def __post_init__(self) -> None:
        self.variance = self.deviation**2

    def learn(self, missed_m: float, amount: float, variance_m2: float) -> None:
        """Update by the error of the wheels' `amount` [m or rad] against a measured distance.

        `missed_m` is that error, `variance_m2` the variance of its measurement.
        """
        self.variance += self.drift**2
        innovation_m2 = self.variance * amount**2 + variance_m2
        limit_m = OUTLIER * math.sqrt(innovation_m2)
        gain = self.variance * amount / innovation_m2
        self.ratio += gain * min(max(missed_m, -limit_m), limit_m)
        self.variance *= 1.0 - gain * amount
