"""Wheels whose size is learnt from modules that measure the way itself.

A tyre's diameter is known to a per cent or two, and no wheel measures it. A camera or laser that
holds its pose over half a metre does (the scale alone of Censi, Franchi, Marchionni and Oriolo,
"Simultaneous calibration of odometry and sensor parameters for mobile robots", T-RO 2013). What is
learnt bridges later, where nothing else tells the way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.hold import Hold
from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_UNKNOWN = 0.02  # standard deviation of the scale before anything is learnt
_LIMIT = 0.03  # no further from 1: half of what the gate lets pass, for it is judged by this
_DRIFT = 0.002  # from span to span: tyres wear, floors change
_SPAN_M = 0.5  # of the way between two poses that are compared ...
_TURN_MAX_RAD = 0.3  # ... which turned no more in all: an arc is longer than its chord
_SLIP = 0.015  # standard deviation of what wheels slip over a span, each time anew
_SIGMAS = 3.0  # more is no scale: a wheel spun, or the module erred


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Mark:
    """Where a span begins."""

    hold: Hold
    T_local_base: Transform
    T_odom_base: Transform
    covariance: NDArray[np.float64]  # (6, 6), of T_local_base


class WheelScale:
    """Corrects the way of one observation's odometry after the other."""

    def __init__(self) -> None:
        self.scale = 1.0
        self._variance = _UNKNOWN**2
        self._T_told: Transform | None = None  # the last odometry, as it came ...
        self._T_odom_base = se3.identity()  # ... and its pose as corrected
        self._is_told = False  # by the newest observation
        self._mark: _Mark | None = None
        self._turned_rad = 0.0  # in all, since the mark

    @property
    def deviation(self) -> float:
        """Return the standard deviation of the scale."""
        return math.sqrt(self._variance)

    def correct(self, observation: Observation) -> Observation:
        """Return the observation with odometry whose way is to scale, as far as is known."""
        before, T_told = self._T_told, observation.T_odom_base
        self._is_told = T_told is not None
        if T_told is None:
            return observation
        self._T_told = T_told
        if before is None:
            self._T_odom_base = T_told
            return observation
        T_prev_curr = se3.inverse(before) @ T_told
        self._turned_rad += float(se3.rotation_angle_rad(T_prev_curr))
        T_prev_curr[:3, 3] *= self.scale
        self._T_odom_base = se3.chained(self._T_odom_base, T_prev_curr)
        self._T_odom_base.setflags(write=False)
        return replace(observation, T_odom_base=self._T_odom_base)

    def learn(self, hold: Hold) -> None:
        """Compare the odometry with what the active module told at the same observation."""
        if not (hold.is_asked and self._is_told):
            return  # one of them speaks more seldom
        here = self._here(hold)
        mark, self._mark = self._mark, here
        if here is None or mark is None or mark.hold is not hold:
            self._turned_rad = 0.0
            return
        odom_m = float(np.linalg.norm(_way(mark.T_odom_base, here.T_odom_base)))
        if self._turned_rad > _TURN_MAX_RAD:
            self._turned_rad = 0.0
        elif odom_m < _SPAN_M:
            self._mark = mark
        else:
            way_m, variance_m2 = _measured(mark, here)
            self._take(way_m / odom_m, variance_m2 / odom_m**2 + _SLIP**2)
            self._turned_rad = 0.0

    def _here(self, hold: Hold) -> _Mark | None:
        """Return where a span may begin or end: where the module measured its pose."""
        is_known = hold.is_trusted and hold.inliers > 0 and not hold.is_revised
        if not is_known or hold.covariance is None or hold.T_local_base is None:
            return None
        assert self._T_told is not None
        return _Mark(
            hold=hold,
            T_local_base=hold.T_local_base,
            T_odom_base=self._T_told,
            covariance=hold.covariance,
        )

    def _take(self, ratio: float, noise: float) -> None:
        """Learn the scale by a span's, whose variance is `noise`."""
        self._variance += _DRIFT**2
        missed = ratio - self.scale
        if abs(missed) > _SIGMAS * math.sqrt(self._variance + noise):
            self._variance = min(2.0 * self._variance, _UNKNOWN**2)  # or what is known is wrong
            return
        gain = self._variance / (self._variance + noise)
        self.scale = min(max(self.scale + gain * missed, 1.0 - _LIMIT), 1.0 + _LIMIT)
        self._variance *= 1.0 - gain


def _measured(mark: _Mark, here: _Mark) -> tuple[float, float]:
    """Return the length [m] of a module's way, and the variance along it of both its ends."""
    way = _way(mark.T_local_base, here.T_local_base)
    way_m = float(np.linalg.norm(way))
    ahead = way / max(way_m, 1e-9)
    ahead_here = here.T_local_base[:3, :3].T @ mark.T_local_base[:3, :3] @ ahead
    variance_m2 = sum(
        float(u @ end.covariance[:3, :3] @ u) for u, end in ((ahead, mark), (ahead_here, here))
    )
    return way_m, variance_m2


def _way(T_from: Transform, T_to: Transform) -> NDArray[np.float64]:
    """Return where (3,) `T_to` is, seen from `T_from`."""
    return np.asarray((se3.inverse(T_from) @ T_to)[:3, 3])
