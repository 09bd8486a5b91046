"""Hand-over: a session is placed (Eq. 1) and catches up before it becomes the active one."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from time import perf_counter_ns

from sceneslam.bus.observation_buffer import (
    BufferedObservation,
    ObservationBuffer,
    bare,
    bridged,
)
from sceneslam.bus.pace import Pace
from sceneslam.bus.session import ModuleSession
from sceneslam.types import se3
from sceneslam.types.observation import Tracking, TrackingStatus
from sceneslam.types.run import BRIDGED
from sceneslam.types.se3 import Transform


class Handover:
    """Advances a session from a buffered observation to now; nothing changes until it is accepted.

    The module is placed at the pose of the last trusted observation at which it tracks. From there
    on its poses are the robot's, and gaps in its tracking are bridged.
    """

    def __init__(
        self,
        session: ModuleSession,
        memory: ObservationBuffer,
        *,
        anchor: BufferedObservation,
        pace: Pace,
    ) -> None:
        assert session.runner is not None
        self.session, self.runner = session, session.runner
        self.anchor = replace(anchor)  # a correction moves that of the memory, too
        self.trail: list[BufferedObservation] = []  # after the anchor; with it, if it is bridged
        self.tracked: list[Tracking] = []  # its answers from the anchor on, while it tracks
        self._pace, self._memory = pace, memory
        self._spared_ns: list[int] = []  # of observations skipped since it tracked
        self._given_ns = anchor.stamp_ns  # the last that it was given and tracked
        self.began_ns, self._done_ns = anchor.stamp_ns, anchor.stamp_ns - 1
        self._reported: Transform | None = None  # the pose of the moment before, as known then
        # Time taken so far, including the start; waiting in between is not counted.
        self._cost_ns = self.runner.start_ns
        self._first_cost_ns = 0  # the same until the first pose

    @property
    def fault(self) -> str:
        """Return why the module would be left at once: `lost` or `silent`, "" if it would not."""
        hold = self.session.hold
        if hold.status is TrackingStatus.LOST or hold.is_suspect:
            return "lost"
        since_ns = hold.unheld_since_ns
        has_data = since_ns is None or self._done_ns - since_ns < hold.patience_ns
        return "" if has_data else "silent"

    @property
    def is_unheard(self) -> bool:
        """Tell whether the module has not answered yet."""
        return self.session.hold.status is None

    def tracked_ns(self, stamp_ns: int) -> int:
        """Return how long it has tracked without a break, 0 if not at the newest observation."""
        hold = self.session.hold
        if hold.tracking is None or hold.tracking.status is not TrackingStatus.TRACKING:
            return 0
        assert hold.held_since_ns is not None
        return stamp_ns - hold.held_since_ns

    def cost(self, stamp_ns: int) -> dict[str, object]:
        """Return the time it took, for the log; this is not reproducible between runs."""
        return {
            "module": self.runner.key,
            "handover_ms": self._cost_ns / 1e6,
            "first_pose_ms": self._first_cost_ns / 1e6,
            "catch_up_s": (stamp_ns - self.began_ns) / 1e9,
        }

    def advance(self, limit: int | None) -> bool:
        """Give the module up to `limit` observations; return whether it has caught up.

        Raises ModuleError when the module violates its contract.
        """
        given = 0
        with self._timed():
            for moment in self._memory.after(self._done_ns):
                if given == limit:
                    self._memory.keep_from(self._done_ns)
                    return False
                given += self._go_on_to(moment)
        return True

    def settle(self) -> None:
        """Place the module, which has caught up, at the pose of the newest observation.

        Its earlier observations belong to its trial, not to the hand-over. Raises ModuleError.
        """
        last, anchor = self.session.hold.tracking, replace(self._memory.newest)
        assert last is not None, "it tracks now"
        self.began_ns, self._cost_ns = anchor.stamp_ns, 0
        self.anchor, self.trail, self.tracked = anchor, [], [last]
        self.session.bridge = anchor.bridge.copy()
        with self._timed():
            self.session.settle(last, anchor.T_map_base)
        self._first_cost_ns = self._cost_ns

    def move(self, T_new_old: Transform) -> None:
        """Go on in a map that the module which is left has corrected by (4, 4)."""
        session = self.session
        session.bridge = session.bridge.moved(T_new_old)
        if self._reported is not None:
            self._reported = T_new_old @ self._reported
        for moment in [self.anchor, *self.trail]:
            moment.move(T_new_old)
        if session.is_placed:
            assert self.runner.T_map_local is not None
            self.runner.place(T_new_old @ self.runner.T_map_local)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        self._since_ns = perf_counter_ns()
        try:
            yield
        finally:
            self._cost_ns += perf_counter_ns() - self._since_ns

    def _go_on_to(self, moment: BufferedObservation) -> bool:
        """Give the module a buffered observation or skip it; return whether it was given."""
        session, motion = self.session, self._motion_to(moment)
        self._done_ns, self._reported = moment.stamp_ns, moment.T_map_base
        if not session.is_placed and moment.is_trusted:
            self.anchor, self.trail, session.bridge = replace(moment), [], moment.bridge.copy()
        is_newest = moment is self._memory.newest
        is_tracking = session.is_placed and session.hold.is_held
        is_given = is_newest or not is_tracking or not self._pace.spares(moment.observation)
        self._advance(moment, motion, is_given=is_given)
        return is_given

    def _advance(
        self, moment: BufferedObservation, motion: Transform | None, *, is_given: bool
    ) -> None:
        """Continue to a buffered observation."""
        session, given = self.session, moment.observation
        was_placed = session.is_placed
        if is_given and self.runner.can_use(given):
            self._pace.last = given
        elif self._spared_ns or not is_given:
            self._spared_ns.append(given.stamp_ns)
        T_map_bridged = None
        if is_given and was_placed and self._spared_ns:
            T_map_bridged = session.predict(
                session.bridge.copy(), given, by_velocity=True, T_prev_curr=motion
            )
        found = session.advance(
            given, by_velocity=True, T_prev_curr=motion, is_given=is_given, witness=moment.witness
        )
        if session.fault is not None:
            raise session.fault
        if session.tracking is not None:
            if not was_placed:
                self.tracked = []
                self._first_cost_ns = self._cost_ns + perf_counter_ns() - self._since_ns
            self.tracked.append(session.tracking)
            assert found.T_map_base is not None
            if T_map_bridged is not None and not session.hold.is_revised:
                T_bridged_base = se3.inverse(T_map_bridged) @ found.T_map_base
                self._bend(session.tracking, T_bridged_base)
            self._spared_ns, self._given_ns = [], moment.stamp_ns
        if moment.stamp_ns != self.anchor.stamp_ns or moment.module == BRIDGED:
            found.observation = bare(given)  # the memory bounds what is kept of it
            self.trail.append(found)
        if session.hold.suspect_since_ns is not None:
            self._distrust(session.hold.suspect_since_ns)

    def _distrust(self, since_ns: int) -> None:
        """Replace the module's poses after `since_ns` by bridged ones, where all can be bridged."""
        first = bisect_right(self.trail, since_ns, key=lambda each: each.stamp_ns)
        before = self.trail[first - 1] if first else self.anchor
        found = bridged(before, self.trail[first:])
        if found and all(one.T_map_base is not None for one in found):
            self.trail[first:] = found
            self.session.bridge = found[-1].bridge.copy()

    def _motion_to(self, moment: BufferedObservation) -> Transform | None:
        """Return the motion (4, 4) since the previous observation, as it was estimated then."""
        if self._reported is None or moment.T_map_base is None:
            return None
        return se3.inverse(self._reported) @ moment.T_map_base

    def _bend(self, tracking: Tracking, T_bridged_base: Transform) -> None:
        """Distribute the drift of the trail since the module's last answer, which odometry bridged.

        `T_bridged_base` (4, 4) is the module's pose now, in the frame of the pose that odometry led
        to. What it was not asked about has its key; where it was lost, poses stay bridged.
        """
        xi, given_s = se3.log(T_bridged_base), (tracking.stamp_ns - self._given_ns) / 1e9
        first = bisect_right(self.trail, self._given_ns, key=lambda each: each.stamp_ns)
        for moment in self.trail[first:]:
            share = (moment.stamp_ns - self._given_ns) / 1e9 / given_s
            bent = moment.bridge.follow(moment.observation, se3.exp(share * xi))
            moment.T_map_base = bent
            if moment.stamp_ns in self._spared_ns:
                assert self.runner.T_map_local is not None
                T_local_base = se3.inverse(self.runner.T_map_local) @ bent
                moment.module = self.runner.key
                moment.tracking = replace(
                    tracking, stamp_ns=moment.stamp_ns, T_local_base=T_local_base
                )
