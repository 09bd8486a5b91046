"""Estimate the wheels' scale from modules that measure distances themselves.

A tyre's diameter is known to 1 or 2 per cent, and wheel encoders cannot measure it. A camera or
laser that tracks over half a metre can (the scale alone of Censi, Franchi, Marchionni and Oriolo,
"Simultaneous calibration of odometry and sensor parameters for mobile robots", T-RO 2013). The
scale estimated from one module corrects the odometry for the other modules.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.judging.hold import Hold
from sceneslam.motion.distance_error import DistanceError
from sceneslam.types import se3
from sceneslam.types.observation import Tracking
from sceneslam.types.se3 import Transform

_DRIFT = 0.002  # standard deviation of the change between spans: tyres wear, floors change
_SPAN_M = 0.5  # distance between two poses that are compared
_TURN_MAX_RAD = 1.0  # between them: wheels that turn it 2 % too far shorten the chord by 0.2 %
# Standard deviation of the wheels' slip over 1 m, 1.5 % over a span; grows with the square root.
_SLIP_M = 0.011


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Mark:
    """Where a span begins."""

    hold: Hold
    held_since_ns: int | None  # the module has tracked without a break since then
    tracking: Tracking  # its answer there, with a covariance
    T_odom_base: Transform

    def continues(self, mark: _Mark) -> bool:
        """Tell whether the module's poses here and at the mark can be compared."""
        return (
            mark.hold is self.hold
            and mark.held_since_ns == self.held_since_ns
            and mark.tracking.revision == self.tracking.revision
        )


class WheelScale:
    """Estimates the scale of the wheels' distances from one module.

    `deviation` is its standard deviation before the first measurement, `limit` its largest
    difference from 1.
    """

    def __init__(self, *, deviation: float, limit: float) -> None:
        self._error, self._limit = DistanceError(deviation, drift=_DRIFT), limit
        self._mark: _Mark | None = None
        self._turned_rad = 0.0  # sum since the mark

    @property
    def scale(self) -> float:
        """Return the true distance per metre of odometry."""
        return 1.0 + min(max(self._error.ratio, -self._limit), self._limit)

    @property
    def variance(self) -> float:
        """Return the variance of the scale."""
        return self._error.variance

    def learn(self, hold: Hold, T_odom_base: Transform | None, turned_rad: float) -> None:
        """Compare uncorrected odometry (4, 4) and its turn [rad] with the module's pose."""
        self._turned_rad += turned_rad
        here = _here(hold, T_odom_base)
        if here is None:
            return  # the span goes on
        mark = self._mark
        if mark is not None and here.continues(mark) and self._turned_rad <= _TURN_MAX_RAD:
            odom_m = float(np.linalg.norm(_way(mark.T_odom_base, here.T_odom_base)))
            if odom_m < _SPAN_M:
                return
            way_m, variance_m2 = _measured(mark, here)
            missed_m = way_m - odom_m * (1.0 + self._error.ratio)
            self._error.learn(missed_m, odom_m, variance_m2 + _SLIP_M**2 * odom_m)
        self._mark, self._turned_rad = here, 0.0


def _here(hold: Hold, T_odom_base: Transform | None) -> _Mark | None:
    """Return the current pose as a span's end, None unless the module measured it."""
    tracking = hold.tracking
    if tracking is None or T_odom_base is None or not hold.is_trusted:
        return None
    if tracking.inliers <= 0 or tracking.covariance is None:
        return None
    held_since_ns = hold.held_since_ns
    return _Mark(hold=hold, held_since_ns=held_since_ns, tracking=tracking, T_odom_base=T_odom_base)


def _measured(mark: _Mark, here: _Mark) -> tuple[float, float]:
    """Return the length [m] of the module's motion, and the variance along it of both its ends."""
    then, now = mark.tracking, here.tracking
    assert then.covariance is not None and now.covariance is not None
    way = _way(then.T_local_base, now.T_local_base)
    way_m = float(np.linalg.norm(way))
    ahead = way / max(way_m, 1e-9)
    ahead_here = now.T_local_base[:3, :3].T @ then.T_local_base[:3, :3] @ ahead
    variance_m2 = sum(
        float(u @ covariance[:3, :3] @ u)
        for u, covariance in ((ahead, then.covariance), (ahead_here, now.covariance))
    )
    return way_m, variance_m2


def _way(T_from: Transform, T_to: Transform) -> NDArray[np.float64]:
    """Return the position (3,) [m] of `T_to` in the frame of `T_from`."""
    return np.asarray((se3.inverse(T_from) @ T_to)[:3, 3])
