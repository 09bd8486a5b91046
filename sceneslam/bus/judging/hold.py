"""Health of an active module: whether it tracks, and whether its motion is trusted."""

from __future__ import annotations

import math
from collections import deque
from enum import StrEnum
from statistics import median_low

import numpy as np
from numpy.typing import NDArray

from sceneslam.bus.judging.gate import NOBODY, Gate, Witness
from sceneslam.bus.judging.recent import CovarianceMonitor
from sceneslam.bus.judging.runner import Runner
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.se3 import Transform


class Health(StrEnum):
    """How reliable the active module's pose is."""

    HELD = "held"
    LOST = "lost"  # the module reports it
    SILENT = "silent"  # its sensors have delivered no data for longer than usual
    SUSPECT = "suspect"  # its motion disagrees with independent measurements
    FAILED = "failed"  # it violated its contract and was stopped


class Hold:
    """Follows one activation of a module: since when it tracks, is lost, silent or suspect."""

    def __init__(self, *, patience_ns: int, gate: Gate | None) -> None:
        self.status: TrackingStatus | None = None  # None before its first answer
        self.is_suspect = False  # from a disagreement on until it has agreed for long enough
        self.suspect_since_ns: int | None = None  # where suspicion begins: since when it may err
        self.is_trusted = False  # another module may start from its last pose
        self.agrees = False  # for some time it has moved as wheels and gyro say
        self.wheels_lie = False  # by the module's motion and the robot's inertia
        self.wheels_jumped = False  # then: their velocity changed as no robot's can
        self.answer: Tracking | None = None  # to the last observation, unless it is lost
        self.tracking: Tracking | None = None  # the same, if usable
        self.degraded_ns = -1  # stamp of its last answer that was DEGRADED
        self.is_revised = False  # its last pose jumped because it corrected its past
        self.unheld_since_ns: int | None = None
        self.adrift_since_ns: int | None = None  # since when it is lost where it could begin a map
        self.held_since_ns: int | None = None
        self.held_ns = 0  # how long it had tracked without a break before that
        self.turn: NDArray[np.float64] | None = None  # its last (3, 3) rotation, if trusted
        self._T_odom_prev: Transform | None = None
        self._agreed: tuple[Transform, Transform] | None = None  # local, odom, as turns last agreed
        self._gate = gate
        self._covariances = CovarianceMonitor()
        self._revision = 0
        self._fed_ns: int | None = None  # when its sensors last delivered data
        self.patience_ns = patience_ns  # also a guess of their period, until there are intervals
        self._intervals_ns: deque[int] = deque(maxlen=3)  # between their last data

    @property
    def lie_until_ns(self) -> int:
        """Return until when the wheels lie, as far as is known."""
        return -1 if self._gate is None else self._gate.lie_until_ns

    @property
    def is_held(self) -> bool:
        """Tell whether the module tracks, as far as is known."""
        return self.held_since_ns is not None

    @property
    def health(self) -> Health:
        """Return the module's health."""
        if self.unheld_since_ns is None:
            return Health.HELD
        if self.is_suspect and self.adrift_since_ns is None:
            return Health.SUSPECT
        return Health.LOST if self.status is TrackingStatus.LOST else Health.SILENT

    def ask(self, runner: Runner, observation: Observation, witness: Witness) -> Tracking | None:
        """Return a module's answer if its pose may be used; raises ModuleError as the runner."""
        self.is_trusted, self.answer, self.tracking = False, None, None
        if not runner.can_use(observation):
            runner.skip(observation)
            self.spare(observation)
            if self._fed_ns is None or observation.stamp_ns - self._fed_ns > 2 * self._period_ns:
                self.lose(observation.stamp_ns, self._fed_ns)
                self.adrift_since_ns = None
            return None
        tracking = runner.track(observation)
        self._feed(tracking)
        is_lost = tracking.status is TrackingStatus.LOST
        is_tracking = tracking.status is TrackingStatus.TRACKING
        covariance = tracking.covariance if is_tracking else None
        T_local_base = None if is_lost else tracking.T_local_base
        self._judge(observation, T_local_base, covariance, witness)
        self.answer = None if is_lost else tracking
        if tracking.status is TrackingStatus.DEGRADED:
            self.degraded_ns = tracking.stamp_ns
        if is_lost or self.is_suspect:
            self.lose(tracking.stamp_ns)
            return None
        self.tracking = tracking
        is_usual = self._covariances.is_usual(tracking.covariance)
        self.is_trusted = is_usual and is_tracking
        self.unheld_since_ns = None
        if self.held_since_ns is None:
            self.held_since_ns = tracking.stamp_ns
        return tracking

    def spare(self, observation: Observation) -> None:
        """Record an observation that is not given to the module."""
        self.is_trusted, self.answer, self.tracking = False, None, None
        self.is_revised = False
        self._judge(observation, None)

    @property
    def _period_ns(self) -> int:
        """Return the median of the last intervals: one may be a gap, or of a burst."""
        if not self._intervals_ns:
            return self.patience_ns
        return median_low(self._intervals_ns)

    def _feed(self, tracking: Tracking) -> None:
        if self._fed_ns is not None:
            self._intervals_ns.append(tracking.stamp_ns - self._fed_ns)
        self._fed_ns, self.status, self.is_revised = tracking.stamp_ns, tracking.status, False
        if tracking.status is TrackingStatus.LOST:  # its pose is the one before
            if not tracking.can_begin:
                self.adrift_since_ns = None
            elif self.adrift_since_ns is None:
                self.adrift_since_ns = tracking.stamp_ns
        else:
            self.adrift_since_ns = None
            self.is_revised = tracking.revision != self._revision
            self._revision = tracking.revision

    def _judge(
        self,
        observation: Observation,
        T_local_base: Transform | None,
        covariance: NDArray[np.float64] | None = None,
        witness: Witness = NOBODY,
    ) -> None:
        """Compare the module's motion with the odometry's."""
        self.turn, self.suspect_since_ns, self.agrees = None, None, False
        T_odom_prev, self._T_odom_prev = self._T_odom_prev, observation.T_odom_base
        if self._gate is None:
            return
        judgement = self._gate.update(
            observation.stamp_ns,
            T_local_base=T_local_base,
            T_odom_base=observation.T_odom_base,
            is_revised=self.is_revised,
            deviation_m=None if covariance is None else _deviation_m(covariance),
            witness=witness,
        )
        self.agrees = judgement.is_trusted and judgement.turn_agrees
        self.wheels_lie, self.wheels_jumped = judgement.wheels_lie, judgement.wheels_jumped
        if judgement.is_wrong:
            self.suspect_since_ns = None if self.is_suspect else judgement.since_ns
            self.is_suspect = True
        elif judgement.is_trusted:
            self.is_suspect = False
        if self.is_revised and T_local_base is not None:
            self._agreed = None  # its earlier pose is not comparable with its corrected ones
        if judgement.turn_agrees and T_local_base is not None:
            assert observation.T_odom_base is not None
            now = (T_local_base, observation.T_odom_base)
            if self._agreed is not None and T_odom_prev is not None:
                self.turn = _turn(*self._agreed, *now, T_odom_prev)
            self._agreed = now

    def lose(self, stamp_ns: int, held_until_ns: int | None = None) -> None:
        """Record that the module does not track, for whatever reason; silent, since earlier."""
        if self.unheld_since_ns is None:
            self.unheld_since_ns = stamp_ns
            until_ns = stamp_ns if held_until_ns is None else held_until_ns
            self.held_ns = 0 if self.held_since_ns is None else until_ns - self.held_since_ns
            self.held_since_ns = None


def _turn(
    T_local_then: Transform,
    T_odom_then: Transform,
    T_local_now: Transform,
    T_odom_now: Transform,
    T_odom_prev: Transform,
) -> NDArray[np.float64]:
    """Return the last step's rotation (3, 3): the wheels', corrected by the module's since `then`.

    A module that was lost or suspect in between knows its heading better than the wheels do.
    """
    if T_odom_then is T_odom_prev:
        return np.asarray(T_local_then[:3, :3].T @ T_local_now[:3, :3])  # no step in between
    by_module = se3.yaw_rad(se3.inverse(T_local_then) @ T_local_now)
    missed_rad = by_module - se3.yaw_rad(se3.inverse(T_odom_then) @ T_odom_now)
    step_rad = se3.yaw_rad(se3.inverse(T_odom_prev) @ T_odom_now)
    return se3.from_xy_yaw(0.0, 0.0, step_rad + missed_rad)[:3, :3]


def _deviation_m(covariance: NDArray[np.float64]) -> float:
    """Return the standard deviation of the position [m] of a (6, 6) covariance."""
    return math.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
