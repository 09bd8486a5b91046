"""The gate: compare a module's motion with an independent one, from wheels or another source.

Wheels measure distance well and turns badly; cameras the other way round, and one without a
metric sensor guesses its scale. So distance and turn are checked separately: a module with a
wrong scale still measures turns better than wheels (gyrodometry, Borenstein and Feng, ICRA 1996).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.judging.recent import RecentMedian
from sceneslam.types import se3
from sceneslam.types.ranges import check_above
from sceneslam.types.rig import Wheels
from sceneslam.types.se3 import Transform


@dataclass(slots=True, kw_only=True)
class GateSettings:
    """How far two correct motions may differ: `sigmas` standard deviations of the independent one.

    The standard deviation is that of wheels on a floor: it grows with the distance and the turn, on
    top of a constant part from slip and clock offsets. A module's own covariance does not widen the
    bounds: where a module is less certain than the wheels, the wheels' motion is the better one.
    """

    sigmas: float

    def __post_init__(self) -> None:
        check_above(0, sigmas=self.sigmas)


@dataclass(frozen=True, slots=True, kw_only=True)
class Witness:
    """What others than the judged module say of the odometry at an observation."""

    missed_rad: float | None = None  # yaw by wheels alone since the start, less the gyro's
    is_vouched: bool = False  # another module, which measures without wheels, moved as they did


NOBODY = Witness()


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """How far a module's motion is trusted at one observation."""

    is_trusted: bool  # its pose may be used: it has agreed for long enough, or nothing checks it
    is_wrong: bool = False  # it differs by more than the bounds
    since_ns: int | None = None  # then: since when it may have been wrong
    turn_agrees: bool = False  # its turn is within the bounds, and so better than the wheels'
    wheels_lie: bool = False  # they disagree with a module that is certain and moves plausibly
    wheels_jumped: bool = False  # then: their velocity changed as no robot's can


# Motions are compared over each: a jump shows in the shorter, a slow slide in the longer
# (experiments/openloris.md).
_HORIZONS_NS = (1_000_000_000, 5_000_000_000)
_PROBATION_NS = 1_000_000_000  # a module is trusted after agreeing over a whole horizon
# Any two motions differ by this: sensor clocks 0.05 s apart at 0.6 m/s and 20 deg/s.
_DISTANCE_M, _TURN_RAD = 0.03, 0.0175
_BROKEN_RATIO = 0.5  # of the distance; no wrong scale explains more: the turn is wrong, too
# A robot accelerates by up to 1.5 m/s^2; a point 1 m ahead also by the angular acceleration.
_STEP_NS = 300_000_000  # interval for velocities and their changes
_STEP_S = _STEP_NS / 1e9
_LATE_NS = 1_300_000_000  # a disagreement shows within the shortest horizon after it began
_JUMP_M_S = 0.2  # less is noise of the best modules
_JUMP_SIGMAS = 3.0  # of a module's own noise; every observation is judged
_JUMP_RATIO = 1.5  # times the other's change of velocity, to be the one that jumped
_EXPLAINED = 0.5  # least share of a disagreement that the jump that caused it explains
# Median difference of normal errors: below 0.7 standard deviations; of the larger of two: below 1.
_USUAL_SIGMAS = 1.5
_USUAL_STEP_M, _USUAL_STEP_NS = 0.02, 200_000_000  # least spacing of the excesses
_USUAL_MIN, _USUAL_KEPT = 100, 150  # 20 to 30 s of driving: a short fault is no wrong scale


@dataclass(slots=True, kw_only=True, eq=False)
class _Sample:
    stamp_ns: int
    T_local_base: Transform
    T_odom_base: Transform
    way_m: float  # distance driven until then
    turn_rad: float  # turned until then
    missed_rad: float | None  # of wheels alone until then, by the gyro

    @property
    def R_local_odom(self) -> NDArray[np.float64]:
        """Return the rotation (3, 3) between the frames, constant while both rotate alike."""
        return np.asarray(self.T_local_base[:3, :3] @ self.T_odom_base[:3, :3].T)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Excess:
    """Differences of two motions over their bounds; above 1 is too much."""

    distance: float
    turn: float
    apart_m: float  # of points 1 m ahead of base, which move in a turn as well
    is_refuted: bool  # the yaw is too much, though the wheels alone turned as the gyro did


@dataclass(frozen=True, slots=True, kw_only=True)
class _Jump:
    """A change of velocity; one in a gap is known when the velocity after it is."""

    known_m_s: float
    possible_m_s: float  # until then


class Gate:
    """Follows one activation of one module; its output depends on its inputs alone.

    Two correct motions differ by about one standard deviation. If the distance usually differs by
    more, the module's scale is wrong, even though it seldom differs by as much as `sigmas`.
    """

    def __init__(self, settings: GateSettings, wheels: Wheels, *, lie_until_ns: int = -1) -> None:
        """Begin; wheels that another module showed to be wrong are not believed for some time."""
        self.lie_until_ns = lie_until_ns  # so long the wheels lie, if no module tracks
        self._sigmas, self._wheels = settings.sigmas, wheels
        self._samples: list[_Sample] = []  # by rising stamp, back to the longest horizon
        self._first: _Sample | None = None  # with which the activation began
        self._T_odom_base: Transform | None = None
        self._odom_ns = 0  # when odometry was there last
        self._unchecked = Judgement(is_trusted=True)  # while the next odometry is awaited
        self._way_m, self._turn_rad = 0.0, 0.0
        self._is_revised = False  # the module corrected its past since the last sample
        self._within_since_ns = 0  # since when both have been within bounds
        self._module_erred = False  # the module was at fault, since the two agreed
        self._have_wheels_jumped = False  # the same of the wheels
        self._wheels_erred = False  # the wheels were at fault, since the two agreed
        self._is_acute = False  # the shortest horizon shows a disagreement
        # The newest excesses of distance while the wheels were right.
        self._distances = RecentMedian(_USUAL_KEPT, width=1)
        self._usual_excess = 0.0  # their median
        self._usual_m, self._usual_ns = 0.0, 0  # path length and stamp at the newest

    def update(
        self,
        stamp_ns: int,
        *,
        T_local_base: Transform | None,
        T_odom_base: Transform | None,
        is_revised: bool = False,
        deviation_m: float | None = None,
        witness: Witness = NOBODY,
    ) -> Judgement:
        """Return how far the module is trusted at an observation.

        `T_local_base` (4, 4) is None while the module is lost, `T_odom_base` (4, 4) without
        independent motion. `is_revised`: the module corrected its past, so that its pose jumps
        without motion. `deviation_m`: standard deviation of the module's position, None if unknown.
        """
        self._is_revised |= is_revised
        if T_odom_base is None:
            is_silent = stamp_ns - self._odom_ns > _PROBATION_NS
            return Judgement(is_trusted=True) if is_silent else self._unchecked
        self._odom_ns = stamp_ns
        T_odom_prev, self._T_odom_base = self._T_odom_base, T_odom_base
        if T_odom_prev is not None:
            self._way_m += _norm(T_odom_base[:3, 3] - T_odom_prev[:3, 3])
            self._turn_rad += _angle_rad(T_odom_base[:3, :3] - T_odom_prev[:3, :3])
        if T_local_base is None:
            lie = stamp_ns <= self.lie_until_ns
            self._unchecked = replace(self._unchecked, wheels_lie=lie)
            return Judgement(is_trusted=False, wheels_lie=lie)
        if self._is_revised and self._samples:
            self._move_past(self._samples[-1], T_local_base, T_odom_base)
        self._is_revised = False
        now = _Sample(
            stamp_ns=stamp_ns,
            T_local_base=T_local_base,
            T_odom_base=T_odom_base,
            way_m=self._way_m,
            turn_rad=self._turn_rad,
            missed_rad=witness.missed_rad,
        )
        if self._samples:
            judgement = self._judge(now, deviation_m, witness)
            if judgement.wheels_lie:
                self.lie_until_ns = stamp_ns + _HORIZONS_NS[-1]
            elif judgement.is_trusted:  # over a horizon: less shows no slow slip
                self.lie_until_ns = -1
        else:
            judgement = self._begin(now)
        self._samples.append(now)
        self._unchecked = Judgement(
            is_trusted=judgement.is_trusted, wheels_lie=judgement.wheels_lie
        )
        return judgement

    def _move_past(self, last: _Sample, T_local_base: Transform, T_odom_base: Transform) -> None:
        """Move the samples by the module's correction of its past.

        Since the last sample the robot moved as odometry measured.
        """
        T_local_old = last.T_local_base @ se3.inverse(last.T_odom_base) @ T_odom_base
        T_new_old = T_local_base @ se3.inverse(T_local_old)
        for sample in self._samples:
            sample.T_local_base = T_new_old @ sample.T_local_base

    def _begin(self, now: _Sample) -> Judgement:
        self._first, self._within_since_ns = now, now.stamp_ns
        self._usual(now, 0.0)
        return Judgement(is_trusted=False, wheels_lie=now.stamp_ns <= self.lie_until_ns)

    def _judge(self, now: _Sample, deviation_m: float | None, witness: Witness) -> Judgement:
        found = self._anchors(now.stamp_ns)
        excesses = [_excess(then, now, self._sigmas, self._wheels) for then in found]
        newest = max(excesses[0].distance, excesses[0].turn)
        if self._is_acute and newest <= 1.0:
            self._forget_before(found[0])  # the disagreement is over, and was judged
            found, excesses = found[:1], excesses[:1]
        self._is_acute = newest > 1.0
        distance = max(excess.distance for excess in excesses)
        turn = max(excess.turn for excess in excesses)
        distance = max(distance, self._usual(now, distance) / _USUAL_SIGMAS * self._sigmas)
        is_wrong = max(distance, turn) > 1.0
        if is_wrong:
            self._within_since_ns = now.stamp_ns
        is_long = now.stamp_ns - self._within_since_ns >= _PROBATION_NS
        if is_long:
            # They belong to another disagreement.
            self._module_erred = self._have_wheels_jumped = self._wheels_erred = False
        if is_wrong and (witness.is_vouched or any(excess.is_refuted for excess in excesses)):
            self._module_erred, self._wheels_erred = True, False  # two against one
        apart_m = max(excess.apart_m for excess in excesses)
        if is_wrong and self._is_wheels_fault(found[-1], now, apart_m, deviation_m):
            self._distances, self._usual_excess = RecentMedian(_USUAL_KEPT, width=1), 0.0
            return Judgement(
                is_trusted=True, wheels_lie=True, wheels_jumped=self._have_wheels_jumped
            )
        # There is no probation for turns: a module that was wrong and is within the bounds again
        # turns correctly, and the wheels' turn would be worse meanwhile.
        return Judgement(
            is_trusted=is_long,
            is_wrong=is_wrong,
            since_ns=found[0].stamp_ns if is_wrong else None,
            turn_agrees=turn <= 1.0,
        )

    def _is_wheels_fault(
        self, then: _Sample, now: _Sample, apart_m: float, deviation_m: float | None
    ) -> bool:
        """Tell whether a disagreement is the wheels' fault, by the robot's inertia.

        The one at fault changes its velocity abruptly, as no robot can, and the other does not. If
        neither did, a module that is more certain than the wheels is right: wheel errors persist.
        A change of velocity counts if it explains a part of the disagreement of `apart_m` metres.
        While the module is less certain, or its change of velocity in a gap is not known, what was
        found last of this disagreement stands; whether the wheels jumped is noted meanwhile.
        """
        wheels_m = _DISTANCE_M + self._wheels.drift_ratio * (now.way_m - then.way_m)
        module, wheels = self._jumps(now)
        least_m_s = max(_JUMP_M_S, _EXPLAINED * apart_m / _STEP_S)
        least_wheels_m_s = max(least_m_s, _JUMP_RATIO * module.possible_m_s)
        self._have_wheels_jumped |= wheels.known_m_s > least_wheels_m_s
        if deviation_m is not None and deviation_m <= wheels_m and not self._module_erred:
            # A change of velocity is made of three positions, weighted 1, -2, 1.
            noise_m_s = math.sqrt(6.0) * deviation_m / _STEP_S
            least_m_s = max(least_m_s, _JUMP_SIGMAS * noise_m_s, _JUMP_RATIO * wheels.possible_m_s)
            self._module_erred = module.known_m_s > least_m_s
            if self._module_erred or module.possible_m_s <= least_m_s:
                self._wheels_erred = not self._module_erred
        return self._wheels_erred

    def _jumps(self, now: _Sample) -> tuple[_Jump, _Jump]:
        """Return the largest recent changes of velocity: the module's, the wheels'."""
        until_ns = now.stamp_ns
        for _ in range(2):  # two velocities back, and so before a gap that has just ended
            until_ns = self._samples[max(self._until(until_ns - _STEP_NS) - 1, 0)].stamp_ns
        late = [*self._samples[self._until(until_ns - _LATE_NS) :], now]
        times_s = np.array([(sample.stamp_ns - now.stamp_ns) / 1e9 for sample in late])
        before = np.searchsorted(times_s, times_s - _STEP_S, side="right") - 1
        earlier = before.copy()  # whose velocity it is compared with
        if late[0] is self._first:  # since then there are shorter intervals only
            before[1:] = np.maximum(before[1:], 0)
            earlier = np.where(before > 0, before, np.arange(len(late)) - 1)
        later = np.searchsorted(before, np.arange(len(late)))  # whose velocity begins there
        is_followed = later < len(late)
        later = np.where(is_followed, later, -1)
        elapsed_s = np.where(before >= 0, times_s - times_s[before], np.nan)
        # Over a short interval, an error of position makes a larger one of velocity.
        share = np.minimum(np.minimum(elapsed_s, 2.0 * elapsed_s[earlier]), _STEP_S) / _STEP_S
        # Across a gap, a change has acted for longer and explains more. A robot may start or stop
        # meanwhile: what counts is the detour from the velocity before to the one after.
        longer = np.maximum(elapsed_s - np.median(np.diff(times_s)), _STEP_S) / _STEP_S
        found = []
        for poses in ([one.T_local_base for one in late], [one.T_odom_base for one in late]):
            points = np.array([T[:3, 3] + T[:3, 0] for T in poses])
            velocities = (points - points[before]) / elapsed_s[:, None]
            change = np.linalg.norm(velocities - velocities[earlier], axis=1)
            back = np.linalg.norm(velocities[later] - velocities, axis=1)
            across = np.linalg.norm(velocities[later] - velocities[earlier], axis=1)
            detour = np.where(is_followed, (change + back - across) / 2.0, 0.0)
            known = share * np.maximum(change, longer * detour)
            possible = np.where(is_followed, known, share * longer * change)
            found.append(_Jump(known_m_s=_largest(known), possible_m_s=_largest(possible)))
        return found[0], found[1]

    def _usual(self, now: _Sample, excess: float) -> float:
        """Return the median of the recent distance excesses, 0 before it is known."""
        is_far = now.way_m - self._usual_m >= _USUAL_STEP_M
        if is_far and now.stamp_ns - self._usual_ns >= _USUAL_STEP_NS:
            self._usual_m, self._usual_ns = now.way_m, now.stamp_ns
            self._distances.add(excess)
            if len(self._distances) >= _USUAL_MIN:
                self._usual_excess = float(self._distances.median[0])
        return self._usual_excess

    def _anchors(self, stamp_ns: int) -> list[_Sample]:
        """Return, per horizon, the newest sample before it, or the oldest while it is not filled.

        Older samples are forgotten.
        """
        found = [
            self._samples[max(self._until(stamp_ns - horizon_ns) - 1, 0)]
            for horizon_ns in _HORIZONS_NS
        ]
        self._forget_before(found[-1])
        return found

    def _until(self, stamp_ns: int) -> int:
        """Return how many samples there are until a stamp."""
        return bisect_right(self._samples, stamp_ns, key=lambda sample: sample.stamp_ns)

    def _forget_before(self, sample: _Sample) -> None:
        del self._samples[: self._until(sample.stamp_ns - 1)]


def _excess(then: _Sample, now: _Sample, sigmas: float, wheels: Wheels) -> _Excess:
    """Return the differences of the module's motion from the odometry's, divided by the bounds."""
    moved_local = now.T_local_base[:3, 3] - then.T_local_base[:3, 3]
    moved_odom = now.T_odom_base[:3, 3] - then.T_odom_base[:3, 3]
    R_local_odom = then.R_local_odom
    apart_m = _norm(moved_local - R_local_odom @ moved_odom)
    apart_rad = _angle_rad(now.R_local_odom - R_local_odom)
    way_m, turned_rad = now.way_m - then.way_m, now.turn_rad - then.turn_rad
    floor_m = sigmas * _DISTANCE_M
    bound_m = floor_m + sigmas * wheels.drift_ratio * way_m
    deviation_rad = _TURN_RAD + wheels.drift_ratio * turned_rad + wheels.drift_rad_per_m * way_m
    bound_rad = sigmas * deviation_rad
    missed_rad = math.inf
    if then.missed_rad is not None and now.missed_rad is not None:
        missed_rad = abs(now.missed_rad - then.missed_rad)
    broken = apart_m / (floor_m + _BROKEN_RATIO * way_m)
    return _Excess(
        distance=apart_m / bound_m,
        turn=max(apart_rad / bound_rad, broken),
        apart_m=apart_m + apart_rad,
        is_refuted=missed_rad <= bound_rad < abs(se3.yaw_rad(R_local_odom.T @ now.R_local_odom)),
    )


def _largest(values: NDArray[np.float64]) -> float:
    return float(values[np.isfinite(values)].max(initial=0.0))


def _norm(vector: NDArray[np.float64]) -> float:
    return math.sqrt(vector @ vector)


def _angle_rad(difference: NDArray[np.float64]) -> float:
    """Return the angle between two rotations [rad] from their difference (3, 3): its chord."""
    return 2.0 * math.asin(min(_norm(difference.ravel()) / math.sqrt(8.0), 1.0))
