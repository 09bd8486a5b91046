"""The do-no-harm gate: did the robot move as a module says? Wheels, or another, bear witness.

Wheels measure distance well and turns badly; cameras the other way round, and one without a
metric sensor guesses its scale. So distance and turn are judged apart: a module whose scale is
off still tells the turn better than the wheels (Borenstein and Feng's gyrodometry, ICRA 1996).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.recent import RecentMedian
from sceneslam.types import se3
from sceneslam.types.ranges import check_above
from sceneslam.types.rig import Wheels
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

    def __post_init__(self) -> None:
        check_above(0, sigmas=self.sigmas)


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """How far a module is to be believed at one observation."""

    distance: Verdict
    turn: Verdict
    distance_excess: float = 0.0  # the largest difference over its bound; above 1 is too much
    turn_excess: float = 0.0
    since_ns: int | None = None  # from when on the module was right, or may have been wrong
    wheels_lie: bool = False  # they disagree with a module that is certain and moves as robots do

    @property
    def is_trusted(self) -> bool:
        """Tell whether the module's pose may be taken."""
        return self.distance in _GOOD and self.turn in _GOOD


_HORIZONS_S = (1.0, 5.0)  # over each: a jump shows in the shorter, a slow slide in the longer
_PROBATION_NS = 1_000_000_000  # a module is trusted after agreeing over a whole horizon
# Any motion differs by so much: clocks of sensors apart by 0.05 s at 0.6 m/s and 20 deg/s.
_DISTANCE_M, _TURN_RAD = 0.03, 0.0175
_BROKEN_RATIO = 0.5  # off by more of the way than any wrong scale explains: not even the turn
# A robot changes its velocity by 1.5 m/s^2, a point a metre ahead of it by its turns' start, too.
_STEP_S = 0.3  # over which velocities are taken, and changes of them
_LATE_NS = 1_900_000_000  # a disagreement shows within the shortest horizon after it began
_JUMP_M_S = 0.2  # less is noise
_JUMP_RATIO = 1.5  # times the other's, to be the one that began
# Half the differences of normal errors are below 0.7 deviations; of the larger of two, below 1.
_USUAL_SIGMAS = 1.5
_USUAL_STEP_M, _USUAL_STEP_NS = 0.02, 200_000_000  # between two that count, at least
_USUAL_MIN, _USUAL_KEPT = 100, 150  # 20 to 30 s of driving: some seconds of a lie are no scale
_GOOD = (Verdict.AGREE, Verdict.UNCHECKED)


def with_heading(T_prev_curr_odom: Transform, rotation: NDArray[np.float64]) -> Transform:
    """Return the odometry's motion with the heading of a module that is believed the turn.

    `rotation` (3, 3) is the module's over the same time. Wheels stay on the floor: the way is
    theirs, and so are roll and pitch, which a module's tilt would turn into a climb.
    """
    return se3.with_yaw(T_prev_curr_odom, float(np.arctan2(rotation[1, 0], rotation[0, 0])))


@dataclass(slots=True, kw_only=True, eq=False)
class _Sample:
    stamp_ns: int
    R_local_odom: NDArray[np.float64]  # (3, 3), constant while both turn alike
    position_local: NDArray[np.float64]  # (3,) [m]
    position_odom: NDArray[np.float64]  # (3,) [m]
    ahead_local: NDArray[np.float64]  # (3,) [m], a metre ahead of base: it moves in a turn, too
    ahead_odom: NDArray[np.float64]  # (3,) [m]
    way_m: float  # driven until then
    turn_rad: float  # turned until then


@dataclass(frozen=True, slots=True, kw_only=True)
class _Excess:
    """Differences of two motions over their bounds; above 1 is too much."""

    distance: float
    turn: float


class Gate:
    """Follows one activation of one module; what it says depends on what it was given alone.

    Two honest motions differ by a deviation or so: a distance that usually differs by more is of
    another scale, though it seldom differs by as many as `sigmas`.
    """

    def __init__(self, settings: GateSettings, wheels: Wheels) -> None:
        self._sigmas, self._wheels = settings.sigmas, wheels
        self._horizons_ns = [round(horizon_s * 1e9) for horizon_s in _HORIZONS_S]
        self._samples: list[_Sample] = []  # by rising stamp, back to the longest horizon
        self._stamps_ns: list[int] = []  # theirs
        self._T_odom_base: Transform | None = None
        self._held: tuple[Transform, Transform] | None = None  # T_local_base, T_odom_base then
        self._way_m, self._turn_rad = 0.0, 0.0
        self._distance_since_ns: int | None = None  # since when it has not been too far off
        self._has_jumped = False  # the module, as no robot does, since the two agreed
        self._distances = RecentMedian(_USUAL_KEPT, width=1)  # excesses of late
        self._usual_excess = 0.0  # their median
        self._usual_m, self._usual_ns = 0.0, 0  # path and stamp at the last of them

    def update(
        self,
        stamp_ns: int,
        *,
        T_local_base: Transform | None,
        T_odom_base: Transform | None,
        is_revised: bool = False,
        deviation_m: float | None = None,
    ) -> Judgement:
        """Return how far the module is to be believed at an observation.

        `T_local_base` is None where the module is lost, `T_odom_base` where nothing else told the
        motion. `is_revised`: the module corrected its past, and its pose jumps without motion.
        `deviation_m`: the standard deviation that the module states, None where it states none.
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
            ahead_local=T_local_base[:3, 3] + T_local_base[:3, 0],
            ahead_odom=T_odom_base[:3, 3] + T_odom_base[:3, 0],
            way_m=self._way_m,
            turn_rad=self._turn_rad,
        )
        self._held = (T_local_base, T_odom_base)
        judgement = self._judge(now, deviation_m)
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
            sample.ahead_local = T_new_old[:3, :3] @ sample.ahead_local + T_new_old[:3, 3]

    def _judge(self, now: _Sample, deviation_m: float | None) -> Judgement:
        found = self._anchors(now.stamp_ns)
        excesses = [_excess(then, now, self._sigmas, self._wheels) for then in found]
        distance = max((excess.distance for excess in excesses), default=0.0)
        turn = max((excess.turn for excess in excesses), default=0.0)
        distance = max(distance, self._usual(now, distance) / _USUAL_SIGMAS * self._sigmas)
        if self._distance_since_ns is None or max(distance, turn) > 1.0:
            self._distance_since_ns = now.stamp_ns
        elif now.stamp_ns - self._distance_since_ns >= _PROBATION_NS:
            self._has_jumped = False  # that was another disagreement
        is_wrong = max(distance, turn) > 1.0
        if is_wrong and self._is_wheels_fault(found[-1], now, deviation_m):
            return Judgement(
                distance=Verdict.UNCHECKED,
                turn=Verdict.UNCHECKED,
                distance_excess=distance,
                turn_excess=turn,
                wheels_lie=True,
            )
        return Judgement(
            distance=self._verdict(distance, self._distance_since_ns, now, bool(found)),
            turn=_turn_verdict(turn, bool(found)),
            distance_excess=distance,
            turn_excess=turn,
            since_ns=found[0].stamp_ns if is_wrong else self._distance_since_ns,
        )

    def _is_wheels_fault(self, then: _Sample, now: _Sample, deviation_m: float | None) -> bool:
        """Tell whether it is the wheels that lie, where the two disagree; inertia is the third.

        Who lies begins to move otherwise at once, as no robot does, and the other does not. Where
        neither did, a module that is more certain than wheels are is right: wheels err lastingly.
        """
        wheels_m = _DISTANCE_M + self._wheels.drift_ratio * (now.way_m - then.way_m)
        if deviation_m is None or deviation_m > wheels_m:
            return False
        if not self._has_jumped:
            by_module, by_wheels = self._jumps(now)
            self._has_jumped = by_module > _JUMP_M_S and by_module > _JUMP_RATIO * by_wheels
        return not self._has_jumped

    def _jumps(self, now: _Sample) -> tuple[float, float]:
        """Return the largest changes of velocity [m/s] of late: the module's, the wheels'."""
        first = bisect_right(self._stamps_ns, now.stamp_ns - _LATE_NS)
        late = [*self._samples[first:], now]
        times_s = np.array([(sample.stamp_ns - now.stamp_ns) / 1e9 for sample in late])
        before = np.searchsorted(times_s, times_s - _STEP_S, side="right") - 1
        found = []
        for name in ("ahead_local", "ahead_odom"):
            points = np.array([getattr(sample, name) for sample in late])
            is_known = before >= 0
            elapsed_s = (times_s - times_s[before])[is_known, None]
            velocities = np.full_like(points, np.nan)
            velocities[is_known] = (points - points[before])[is_known] / elapsed_s
            changes = np.linalg.norm(velocities - velocities[before], axis=1)[is_known]
            changes = changes[np.isfinite(changes)]
            found.append(float(changes.max(initial=0.0)))
        return found[0], found[1]

    def _usual(self, now: _Sample, excess: float) -> float:
        """Return the median of the distance's excesses of late, 0 before it is known."""
        is_far = now.way_m - self._usual_m >= _USUAL_STEP_M
        if is_far and now.stamp_ns - self._usual_ns >= _USUAL_STEP_NS:
            self._usual_m, self._usual_ns = now.way_m, now.stamp_ns
            self._distances.add(excess)
            if len(self._distances) >= _USUAL_MIN:
                self._usual_excess = float(self._distances.median[0])
        return self._usual_excess

    def _verdict(self, excess: float, since_ns: int, now: _Sample, is_known: bool) -> Verdict:
        if excess > 1.0:
            return Verdict.DISAGREE
        is_long = now.stamp_ns - since_ns >= _PROBATION_NS
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


def _turn_verdict(excess: float, is_known: bool) -> Verdict:
    """Return whether a turn is believed: a sensor's own is better than the wheels', if it may be.

    It is not on probation: a module that was wrong and is within the bounds again turns aright,
    and the wheels' turn meanwhile would be the worse one.
    """
    if excess > 1.0:
        return Verdict.DISAGREE
    return Verdict.AGREE if is_known else Verdict.PROBATION


def _excess(then: _Sample, now: _Sample, sigmas: float, wheels: Wheels) -> _Excess:
    """Return by how much the module's motion differs from the odometry's, over the bounds."""
    moved_local = now.position_local - then.position_local
    moved_odom = now.position_odom - then.position_odom
    apart_m = _norm(moved_local - then.R_local_odom @ moved_odom)
    apart_rad = _angle_rad(now.R_local_odom - then.R_local_odom)
    way_m, turned_rad = now.way_m - then.way_m, now.turn_rad - then.turn_rad
    floor_m = sigmas * _DISTANCE_M
    bound_m = floor_m + sigmas * wheels.drift_ratio * way_m
    deviation_rad = _TURN_RAD + wheels.drift_ratio * turned_rad + wheels.drift_rad_per_m * way_m
    broken = apart_m / (floor_m + _BROKEN_RATIO * way_m)
    return _Excess(
        distance=apart_m / bound_m,
        turn=max(apart_rad / (sigmas * deviation_rad), broken),
    )


def _norm(vector: NDArray[np.float64]) -> float:
    return math.sqrt(vector @ vector)


def _angle_rad(difference: NDArray[np.float64]) -> float:
    """Return the angle between two rotations [rad] from their difference (3, 3): its chord."""
    return 2.0 * math.asin(min(_norm(difference.ravel()) / math.sqrt(8.0), 1.0))
