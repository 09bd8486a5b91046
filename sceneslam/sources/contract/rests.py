"""Detection of rests: gaps in a recording over which odometry did not move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneslam.types import se3
from sceneslam.types.observation import Observation
from sceneslam.types.se3 import Transform

_LONGEST_S = 24 * 3600.0  # no battery lasts longer: the clock was set
_LEAST_M, _LEAST_RAD = 0.05, 0.05  # less is odometry noise, or the robot settling


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """A time without observations, and the motion over it; inf where it is unknown."""

    start_ns: int
    duration_s: float
    moved_m: float
    turned_rad: float


@dataclass(slots=True)
class Rests:
    """Compares the motion over each gap with the largest step of odometry between observations.

    Many loggers write a record only after some motion: the step after a rest is then as long as any
    other, also before the first of these. So all of the run is compared.
    """

    max_gap_ns: int  # a longer step is a gap
    _gaps: list[Gap] = field(default_factory=list, init=False)
    _stamp_ns: int | None = field(default=None, init=False)
    _T_odom_base: Transform | None = field(default=None, init=False)
    _longest_m: float = field(default=_LEAST_M, init=False)
    _widest_rad: float = field(default=_LEAST_RAD, init=False)

    @property
    def rests(self) -> Sequence[Gap]:
        """Return the gaps over which the robot rested, as far as the run is known."""
        return [gap for gap in self._gaps if self._is_rest(gap)]

    @property
    def losses(self) -> Sequence[Gap]:
        """Return the other gaps: the robot moved, or its motion is unknown."""
        return [gap for gap in self._gaps if not self._is_rest(gap)]

    def take(self, observation: Observation) -> None:
        """Update with the next observation of the run."""
        before, self._T_odom_base = self._T_odom_base, observation.T_odom_base
        before_ns, self._stamp_ns = self._stamp_ns, observation.stamp_ns
        if before_ns is None:
            return
        moved_m = turned_rad = np.inf
        if before is not None and self._T_odom_base is not None:
            T_prev_curr = se3.inverse(before) @ self._T_odom_base
            moved_m = float(np.linalg.norm(T_prev_curr[:3, 3]))
            turned_rad = float(se3.rotation_angle_rad(T_prev_curr))
        elapsed_ns = observation.stamp_ns - before_ns
        if elapsed_ns > self.max_gap_ns:
            self._gaps.append(
                Gap(
                    start_ns=before_ns,
                    duration_s=elapsed_ns * 1e-9,
                    moved_m=moved_m,
                    turned_rad=turned_rad,
                )
            )
        elif np.isfinite(moved_m):
            self._longest_m = max(self._longest_m, moved_m)
            self._widest_rad = max(self._widest_rad, turned_rad)

    def _is_rest(self, gap: Gap) -> bool:
        is_still = gap.moved_m <= self._longest_m and gap.turned_rad <= self._widest_rad
        return is_still and gap.duration_s <= _LONGEST_S
