"""The do-no-harm gate: did the robot move as a module says? Wheels, or another, bear witness.

Wheels measure distance well and turns badly; cameras the other way round, and one without a
metric sensor guesses its scale. So distance and turn are judged apart: a module whose scale is
off still tells the turn better than the wheels (Borenstein and Feng's gyrodometry, ICRA 1996).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, fields
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from sceneslam.types import se3
from sceneslam.types.errors import ConfigError
from sceneslam.types.se3 import Transform


class Verdict(Enum):
    """What the independent motion says of a module's."""

    AGREE = "agree"
    DISAGREE = "disagree"
    PROBATION = "probation"  # no disagreement, but not for long enough yet
    UNCHECKED = "unchecked"  # there is no independent motion


@dataclass(slots=True, kw_only=True)
class GateSettings:
    """How far two honest motions may differ: `sigmas` deviations of the independent one.

    Its deviations are those of wheels on a floor: they grow with the way and the turn, on top of
    what slips and the sensors' clocks make of any motion. A module's own covariance does not
    widen the bounds: where a module is less sure than the wheels are, theirs is the better motion.
    """

    sigmas: float
    horizons_s: list[float]  # motions are compared over each; the shortest first
    probation_s: float  # a module is trusted after agreeing for so long
    distance_m: float  # standard deviation of any motion ...
    distance_per_m: float  # ... and per metre driven
    turn_rad: float  # the same of its turn ...
    turn_per_rad: float  # ... per radian turned
    turn_rad_per_m: float  # ... and per metre driven
    broken_ratio: float  # off by more of the way than any wrong scale explains: not even the turn

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "horizons_s" and not 0 <= value < float("inf"):
                raise ConfigError(field.name, value, "0 or more")
        for name in ("sigmas", "distance_m", "turn_rad"):
            if getattr(self, name) == 0:
                raise ConfigError(name, 0, "a number above 0")
        rising = sorted(set(self.horizons_s)) == list(self.horizons_s)
        if not self.horizons_s or not rising or self.horizons_s[0] <= 0:
            raise ConfigError("horizons_s", self.horizons_s, "seconds above 0, the shortest first")


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """How far a module is to be believed at one observation."""

    distance: Verdict
    turn: Verdict
    distance_excess: float = 0.0  # the largest difference over its bound; above 1 is too much
    turn_excess: float = 0.0
    since_ns: int | None = None  # from when on the module was right, or may have been wrong

    @property
    def is_trusted(self) -> bool:
        """Tell whether the module's pose may be taken."""
        return self.distance in _GOOD and self.turn in _GOOD


_GOOD = (Verdict.AGREE, Verdict.UNCHECKED)


def with_heading(T_prev_curr_odom: Transform, rotation: NDArray[np.float64]) -> Transform:
    """Return the odometry's motion with the heading of a module that is believed the turn.

    `rotation` (3, 3) is the module's over the same time. Wheels stay on the floor: the way is
    theirs, and so are roll and pitch, which a module's tilt would turn into a climb.
    """
    module_rad = np.arctan2(rotation[1, 0], rotation[0, 0])
    apart_rad = float(module_rad) - se3.yaw_rad(T_prev_curr_odom)
    return T_prev_curr_odom @ se3.from_xy_yaw(0.0, 0.0, apart_rad)


@dataclass(slots=True, kw_only=True, eq=False)
class _Sample:
    stamp_ns: int
    R_local_odom: NDArray[np.float64]  # (3, 3), constant while both turn alike
    position_local: NDArray[np.float64]  # (3,) [m]
    position_odom: NDArray[np.float64]  # (3,) [m]
    way_m: float  # driven until then
    turn_rad: float  # turned until then


@dataclass(frozen=True, slots=True, kw_only=True)
class _Excess:
    """Differences of two motions over their bounds; above 1 is too much."""

    distance: float
    turn: float


class Gate:
    """Follows one activation of one module; what it says depends on what it was given alone."""

    def __init__(self, settings: GateSettings) -> None:
        self._settings = settings
        self._horizons_ns = [round(horizon_s * 1e9) for horizon_s in settings.horizons_s]
        self._probation_ns = round(settings.probation_s * 1e9)
        self._samples: list[_Sample] = []  # by rising stamp, back to the longest horizon
        self._stamps_ns: list[int] = []  # theirs
        self._T_odom_base: Transform | None = None
        self._held: tuple[Transform, Transform] | None = None  # T_local_base, T_odom_base then
        self._way_m, self._turn_rad = 0.0, 0.0
        self._distance_since_ns: int | None = None  # since when it has not been too far off ...
        self._turn_since_ns: int | None = None

    def update(
        self,
        stamp_ns: int,
        *,
        T_local_base: Transform | None,
        T_odom_base: Transform | None,
        is_revised: bool = False,
    ) -> Judgement:
        """Return how far the module is to be believed at an observation.

        `T_local_base` is None where the module is lost, `T_odom_base` where nothing else told the
        motion. `is_revised`: the module corrected its past, and its pose jumps without motion.
        """
        if T_odom_base is None:
            return Judgement(distance=Verdict.UNCHECKED, turn=Verdict.UNCHECKED)
        T_odom_prev, self._T_odom_base = self._T_odom_base, T_odom_base
        if T_odom_prev is not None:
            self._way_m += _norm(T_odom_base[:3, 3] - T_odom_prev[:3, 3])
            self._turn_rad += _angle_rad(T_odom_base[:3, :3] - T_odom_prev[:3, :3])
        if T_local_base is None:
            return Judgement(distance=Verdict.PROBATION, turn=Verdict.PROBATION)
        if is_revised and self._held is not None:
            self._move_past(T_local_base, T_odom_base, *self._held)
        now = _Sample(
            stamp_ns=stamp_ns,
            R_local_odom=T_local_base[:3, :3] @ T_odom_base[:3, :3].T,
            position_local=T_local_base[:3, 3],
            position_odom=T_odom_base[:3, 3],
            way_m=self._way_m,
            turn_rad=self._turn_rad,
        )
        self._held = (T_local_base, T_odom_base)
        judgement = self._judge(now)
        self._samples.append(now)
        self._stamps_ns.append(stamp_ns)
        return judgement

    def _move_past(
        self,
        T_local_base: Transform,
        T_odom_base: Transform,
        T_local_then: Transform,
        T_odom_then: Transform,
    ) -> None:
        """Bring the samples to where the module now has them; since the last, odometry moved."""
        T_local_old = T_local_then @ se3.inverse(T_odom_then) @ T_odom_base
        T_new_old = T_local_base @ se3.inverse(T_local_old)
        for sample in self._samples:
            sample.R_local_odom = T_new_old[:3, :3] @ sample.R_local_odom
            sample.position_local = T_new_old[:3, :3] @ sample.position_local + T_new_old[:3, 3]

    def _judge(self, now: _Sample) -> Judgement:
        found = self._anchors(now.stamp_ns)
        excesses = [_excess(then, now, self._settings) for then in found]
        distance = max((excess.distance for excess in excesses), default=0.0)
        turn = max((excess.turn for excess in excesses), default=0.0)
        if self._distance_since_ns is None or max(distance, turn) > 1.0:
            self._distance_since_ns = now.stamp_ns
        if self._turn_since_ns is None or turn > 1.0:
            self._turn_since_ns = now.stamp_ns
        is_wrong = max(distance, turn) > 1.0
        return Judgement(
            distance=self._verdict(distance, self._distance_since_ns, now, bool(found)),
            turn=self._verdict(turn, self._turn_since_ns, now, bool(found)),
            distance_excess=distance,
            turn_excess=turn,
            since_ns=found[0].stamp_ns if is_wrong else self._distance_since_ns,
        )

    def _verdict(self, excess: float, since_ns: int, now: _Sample, is_known: bool) -> Verdict:
        if excess > 1.0:
            return Verdict.DISAGREE
        is_long = now.stamp_ns - since_ns >= self._probation_ns
        return Verdict.AGREE if is_known and is_long else Verdict.PROBATION

    def _anchors(self, stamp_ns: int) -> list[_Sample]:
        """Return, per horizon, the newest sample before it, or the oldest while it is not filled.

        Older samples are forgotten.
        """
        if not self._samples:
            return []
        indices = [
            bisect_right(self._stamps_ns, stamp_ns - horizon_ns) - 1
            for horizon_ns in self._horizons_ns
        ]
        found = [self._samples[max(index, 0)] for index in indices]
        old = max(indices[-1], 0)
        del self._samples[:old], self._stamps_ns[:old]
        return found


def _excess(then: _Sample, now: _Sample, settings: GateSettings) -> _Excess:
    """Return by how much the module's motion differs from the odometry's, over the bounds."""
    moved_local = now.position_local - then.position_local
    moved_odom = now.position_odom - then.position_odom
    apart_m = _norm(moved_local - then.R_local_odom @ moved_odom)
    apart_rad = _angle_rad(now.R_local_odom - then.R_local_odom)
    way_m, turned_rad = now.way_m - then.way_m, now.turn_rad - then.turn_rad
    floor_m = settings.sigmas * settings.distance_m
    bound_m = floor_m + settings.sigmas * settings.distance_per_m * way_m
    deviation_rad = (
        settings.turn_rad + settings.turn_per_rad * turned_rad + settings.turn_rad_per_m * way_m
    )
    broken = apart_m / (floor_m + settings.broken_ratio * way_m)
    return _Excess(
        distance=apart_m / bound_m,
        turn=max(apart_rad / (settings.sigmas * deviation_rad), broken),
    )


def _norm(vector: NDArray[np.float64]) -> float:
    return math.sqrt(vector @ vector)


def _angle_rad(difference: NDArray[np.float64]) -> float:
    """Return the angle between two rotations [rad] from their difference (3, 3): its chord."""
    return 2.0 * math.asin(min(_norm(difference.ravel()) / math.sqrt(8.0), 1.0))
