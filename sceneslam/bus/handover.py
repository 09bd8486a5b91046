"""A module on its way to become the active one: started, placed (Eq. 1), and caught up."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter_ns

from sceneslam.atlas.atlas import BRIDGED
from sceneslam.bus.hold import Hold
from sceneslam.bus.memory import Memory, Moment
from sceneslam.bus.runner import Runner
from sceneslam.types import se3
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform


class Handover:
    """Leads a module from a remembered moment to now; nothing is changed until it is accepted.

    The module is placed at the pose of the last trusted moment at which it holds its own. From
    there on its poses are the robot's, and what it does not hold is bridged as ever.
    """

    def __init__(
        self, runner: Runner, memory: Memory, *, anchor: Moment, hold: Hold, scene: str, rig: Rig
    ) -> None:
        self.runner, self.anchor, self.hold = runner, anchor, hold
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
        """Lead the module through up to `limit` moments; return whether it has caught up.

        Raises ModuleError when the module breaks its promise.
        """
        ahead = self._memory.after(self._done_ns)
        with self._timed():
            for moment in ahead[:limit]:
                self._feed(moment)
        return limit is None or len(ahead) <= limit

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

    def _feed(self, moment: Moment) -> None:
        if not self.is_placed and moment.is_trusted:
            self.anchor, self._bridge, self.trail = moment, moment.bridge.copy(), []
        tracking = self.hold.ask(self.runner, moment.observation)
        if tracking is None:
            T_map_base = self._bridge_to(moment)
            self.is_placed = self.is_placed and not self.hold.is_suspect
        else:
            T_map_base = self._place(moment, tracking)
        if moment is not self.anchor or moment.module == BRIDGED:
            self.trail.append(
                Moment(
                    observation=moment.observation,
                    T_map_base=T_map_base,
                    module=BRIDGED if tracking is None else self.runner.key,
                    bridge=self._bridge.copy(),
                    turn=self.hold.turn,
                    covariance=None if tracking is None else tracking.covariance,
                    is_trusted=self.hold.is_trusted,
                )
            )
        self._done_ns, self._told = moment.stamp_ns, moment.T_map_base

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
