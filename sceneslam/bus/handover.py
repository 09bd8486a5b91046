"""A module on its way to become the active one: started, placed (Eq. 1), and caught up."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter_ns

from sceneslam.atlas.atlas import BRIDGED
from sceneslam.bus.hold import Hold
from sceneslam.bus.memory import Memory, Moment
from sceneslam.bus.pace import Pace
from sceneslam.bus.runner import Runner
from sceneslam.types import se3
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform


class Handover:
    """Leads a module from a remembered moment to now; nothing is changed until it is accepted.

    The module is placed at the pose of the last trusted moment at which it holds its own. From
    there on its poses are the robot's, and what it does not hold is bridged as ever.
    """

    def __init__(
        self,
        runner: Runner,
        memory: Memory,
        *,
        anchor: Moment,
        hold: Hold,
        pace: Pace,
        scene: str,
        rig: Rig,
    ) -> None:
        self.runner, self.anchor, self.hold = runner, anchor, hold
        self._pace = pace
        self._spared: list[Moment] = []  # since the last that the module was given ...
        self._given_ns = anchor.stamp_ns  # ... and held its pose
        self.began_at = anchor
        self.trail: list[Moment] = []  # all after the anchor, and itself if no module gave its pose
        self.tracked: list[Tracking] = []  # what it said from the anchor on, where it holds
        self.cost_ns = 0  # that it took so far; what is waited for between is not counted ...
        self.first_cost_ns = 0  # ... and until the first pose
        self._memory, self._bridge = memory, anchor.bridge.copy()
        self._done_ns = anchor.stamp_ns - 1
        self.is_placed = False
        self._told: Transform | None = None  # the pose of the moment before, as told at the time
        with self._timed():
            runner.activate(rig, scene)

    @property
    def is_lost(self) -> bool:
        """Tell whether the module's last word was of no use."""
        return self.hold.status is TrackingStatus.LOST or self.hold.is_suspect

    @property
    def T_map_base(self) -> Transform | None:
        """Return the newest pose, None when there is none."""
        return self.trail[-1].T_map_base if self.trail else self.anchor.T_map_base

    def advance(self, limit: int | None) -> bool:
        """Give the module up to `limit` observations; return whether it has caught up.

        Raises ModuleError when the module breaks its promise.
        """
        given = 0
        with self._timed():
            for moment in self._memory.after(self._done_ns):
                if given == limit:
                    return False
                given += self._go_on_to(moment)
        return True

    def settle(self, anchor: Moment) -> None:
        """Place the module, which has caught up, anew: at the pose of another moment, now.

        What it did before was its trial, not the hand-over.
        """
        last = self.tracked[-1]
        self.began_at, self.cost_ns = anchor, 0
        self.anchor, self.trail, self.tracked = anchor, [], [last]
        self._bridge = anchor.bridge.copy()
        with self._timed():
            self.runner.place(self._bridge.T_map_base @ se3.inverse(last.T_local_base))
        self.first_cost_ns = self.cost_ns

    @contextmanager
    def _timed(self) -> Iterator[None]:
        self._since_ns = perf_counter_ns()
        try:
            yield
        finally:
            self.cost_ns += perf_counter_ns() - self._since_ns

    def _go_on_to(self, moment: Moment) -> bool:
        """Give the module a moment's observation, or spare it that; return whether it was given."""
        if not self.is_placed and moment.is_trusted:
            self.anchor, self._bridge, self.trail = moment, moment.bridge.copy(), []
        is_newest = moment is self._memory.newest
        is_sure = self.is_placed and self.hold.is_held
        if is_sure and not is_newest and self._pace.spares(moment.observation):
            self._spare(moment)
            return False
        tracking = self._ask(moment.observation)
        spared, self._spared = self._spared, []
        for each in spared:
            self._note(each, self._bridge_to(each))
        if tracking is None:
            self._note(moment, self._bridge_to(moment))
            self.is_placed = self.is_placed and not self.hold.is_suspect
        else:
            T_map_told = self._bridge.copy().predict(moment.observation, by_velocity=False)
            T_map_base = self._place(moment, tracking)
            if spared and T_map_told is not None and not self.hold.is_revised:
                self._bend(len(spared), tracking, se3.inverse(T_map_told) @ T_map_base)
            self._note(moment, T_map_base, tracking)
            self._given_ns = moment.stamp_ns
        return True

    def _spare(self, moment: Moment) -> None:
        self._pace.spare(moment.observation)
        self.hold.spare(moment.observation)
        self._spared.append(moment)
        self._done_ns = moment.stamp_ns

    def _ask(self, observation: Observation) -> Tracking | None:
        """Return what the module says, with the gyro samples since it was last given any."""
        if self.runner.can_use(observation):
            return self.hold.ask(self.runner, self._pace.give(observation))
        self._pace.spare(observation)
        return self.hold.ask(self.runner, observation)

    def _note(
        self, moment: Moment, T_map_base: Transform | None, tracking: Tracking | None = None
    ) -> None:
        """Go on to a moment with its pose, and what the module said where it is the module's."""
        if moment is not self.anchor or moment.module == BRIDGED:
            self.trail.append(
                Moment(
                    observation=moment.observation,
                    T_map_base=T_map_base,
                    module=BRIDGED if tracking is None else self.runner.key,
                    bridge=self._bridge.copy(),
                    turn=self.hold.turn,
                    covariance=None if tracking is None else tracking.covariance,
                    is_trusted=tracking is not None and self.hold.is_trusted,
                )
            )
        self._done_ns, self._told = moment.stamp_ns, moment.T_map_base

    def _bend(self, count: int, tracking: Tracking, T_told_base: Transform) -> None:
        """Lay the last poses of the trail, odometry's, between the module's before and after them.

        `T_told_base`: where the module is now, seen from where odometry led.
        """
        xi, given_s = se3.log(T_told_base), (tracking.stamp_ns - self._given_ns) / 1e9
        for index in range(-count, 0):
            moment = self.trail[index]
            share = (moment.stamp_ns - self._given_ns) / 1e9 / given_s
            self.trail[index] = replace(
                moment,
                T_map_base=moment.bridge.follow(moment.observation, se3.exp(share * xi)),
                module=self.runner.key,
                covariance=tracking.covariance,
            )

    def _bridge_to(self, moment: Moment) -> Transform | None:
        """Return a pose that the module did not give: the old one's motion is better than none."""
        observation = moment.observation
        T_map_base = self._bridge.predict(observation, by_velocity=True, turn=self.hold.turn)
        if T_map_base is None and self._told is not None and moment.T_map_base is not None:
            T_prev_curr = se3.inverse(self._told) @ moment.T_map_base
            T_map_base = self._bridge.follow(observation, T_prev_curr)
        return T_map_base

    def _place(self, moment: Moment, tracking: Tracking) -> Transform:
        """Return the pose of a module that holds one; its first is the pose handed over (Eq. 1)."""
        if not self.is_placed:
            self.first_cost_ns = self.cost_ns + perf_counter_ns() - self._since_ns
            self._bridge.predict(moment.observation, by_velocity=True)
            self.runner.place(self._bridge.T_map_base @ se3.inverse(tracking.T_local_base))
            self.tracked, self.is_placed = [], True
        assert self.runner.T_map_local is not None
        T_map_base = self.runner.T_map_local @ tracking.T_local_base
        self._bridge.update(moment.observation, T_map_base, is_jump=self.hold.is_revised)
        self.tracked.append(tracking)
        return T_map_base
