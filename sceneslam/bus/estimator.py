"""The active module and its place in the map: tracking, bridging, and Eq. 1 at a hand-over."""

from __future__ import annotations

import logging
from time import perf_counter_ns

from sceneslam.atlas.atlas import BRIDGED, Atlas
from sceneslam.bus.bridge import Bridge
from sceneslam.bus.events import EventLog
from sceneslam.bus.policy import Policy
from sceneslam.bus.runner import Runner
from sceneslam.types import se3
from sceneslam.types.errors import ModuleError
from sceneslam.types.observation import Observation, Tracking, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)


class Estimator:
    """Gives every observation one pose: the active module's, or a bridged one."""

    def __init__(self, *, policy: Policy, rig: Rig, atlas: Atlas, log: EventLog) -> None:
        self.active: Runner | None = None
        self.lost_since_ns: int | None = None  # since when the active module gives no pose
        self.held_ns = 0  # how long it gave poses without a break before that
        self._handover, self._rig, self._atlas, self._log = policy.handover, rig, atlas, log
        self._bridge = Bridge(velocity_horizon_s=policy.bridge_s)
        self._session: int | None = None  # None until the active module is placed
        self._status: TrackingStatus | None = None
        self._held_since_ns: int | None = None
        self._fed_ns: int | None = None  # when the active module's sensors last spoke ...
        self._unknown_period_ns = round(policy.lost_patience_s * 1e9)
        self._fed_period_ns = self._unknown_period_ns  # ... and how long after the time before

    @property
    def is_lost(self) -> bool:
        """Tell whether the active module's last word was that it is lost."""
        return self._status is TrackingStatus.LOST

    def launch(self, runner: Runner, observation: Observation, scene: str) -> bool:
        """Hand over to a module; return whether it could be activated and fed.

        The module that ran before goes on when the new one fails, and is shut down otherwise.
        """
        began_ns = perf_counter_ns()
        before = (self.active, self._session, self.lost_since_ns, self._held_since_ns)
        self._bridge_to(observation)
        self.active, self._session, self._status = runner, None, None
        self.lost_since_ns, self._held_since_ns, self.held_ns = None, None, 0
        self._fed_ns, self._fed_period_ns = None, self._unknown_period_ns
        try:
            runner.activate(self._rig, scene)
            self.track(observation, by_velocity=True)
        except ModuleError as error:
            _log.warning(str(error))
            self._log.add("fault", observation.stamp_ns, what=str(error))
            runner.retire()
            self.active, self._session, self.lost_since_ns, self._held_since_ns = before
            return False
        cost_ms = (perf_counter_ns() - began_ns) / 1e6
        self._log.add("cost", observation.stamp_ns, module=runner.key, handover_ms=cost_ms)
        self._retire(before[0], before[1])
        return True

    def track(self, observation: Observation, *, by_velocity: bool) -> None:
        """Give the observation its pose; raises ModuleError when the module broke its promise.

        Where the module gives none, odometry bridges, or constant velocity if `by_velocity`.
        """
        assert self.active is not None
        tracking = self._ask(self.active, observation)
        if tracking is not None and tracking.status is not self._status:
            self._status = tracking.status
            self._log.add(
                "tracking",
                observation.stamp_ns,
                module=self.active.key,
                status=tracking.status.value,
            )
        if tracking is None or tracking.status is TrackingStatus.LOST:
            if tracking is not None or self._is_overdue(observation.stamp_ns):
                self._note_loss(observation.stamp_ns)
            self.bridge(observation, by_velocity=by_velocity or tracking is None)
            return
        self._take(observation, tracking)

    def retire(self) -> None:
        """Shut the active module down and keep its map."""
        self._retire(self.active, self._session)
        self.active = None

    def bridge(self, observation: Observation, *, by_velocity: bool) -> None:
        """Give the observation the pose that odometry tells, or constant velocity if allowed."""
        T_map_base = self._bridge.predict(observation, by_velocity=by_velocity)
        if T_map_base is not None:
            self._atlas.add(observation.stamp_ns, T_map_base, BRIDGED)

    def _ask(self, runner: Runner, observation: Observation) -> Tracking | None:
        """Return the module's answer, None when none of its sensors spoke."""
        if not runner.can_use(observation):
            return None
        if self._fed_ns is not None:
            self._fed_period_ns = observation.stamp_ns - self._fed_ns
        self._fed_ns = observation.stamp_ns
        return runner.track(observation)

    def _is_overdue(self, stamp_ns: int) -> bool:
        """Tell whether the module's sensors have been silent for longer than they usually are."""
        return self._fed_ns is None or stamp_ns - self._fed_ns > 2 * self._fed_period_ns

    def _take(self, observation: Observation, tracking: Tracking) -> None:
        """Put the module's pose into the map."""
        assert self.active is not None
        if self._session is None:
            self._place(observation, tracking.T_local_base)
        self.lost_since_ns = None
        if self._held_since_ns is None:
            self._held_since_ns = observation.stamp_ns
        assert self.active.T_map_local is not None
        T_map_base = self.active.T_map_local @ tracking.T_local_base
        self._bridge.update(observation, T_map_base)
        self._atlas.add_local(observation.stamp_ns, tracking.T_local_base)
        self._atlas.add(observation.stamp_ns, T_map_base, self.active.key)

    def _place(self, observation: Observation, T_local_base: Transform) -> None:
        """Place the module so that its first pose is the pose that was handed over (Eq. 1)."""
        assert self.active is not None
        last_ns = self._atlas.last_stamp_ns
        is_seamless = self._atlas.has_pose(observation.stamp_ns)
        self._bridge_to(observation)
        T_map_local = self._bridge.T_map_base @ se3.inverse(T_local_base)
        self.active.place(T_map_local)
        self._session = self._atlas.begin_session(self.active.key, T_map_local)
        self._log.add(
            "handover",
            observation.stamp_ns,
            session=self._session,
            module=self.active.key,
            kind=self._handover,
            T_map_local=T_map_local.tolist(),
            jump_m=0.0 if is_seamless else None,  # it starts at the very pose of this instant
            jump_rad=0.0 if is_seamless else None,
            gap_s=0.0 if last_ns is None else (observation.stamp_ns - last_ns) / 1e9,
        )

    def _bridge_to(self, observation: Observation) -> None:
        """Move the bridge to the observation unless its pose is known."""
        if not self._atlas.has_pose(observation.stamp_ns):
            self._bridge.predict(observation, by_velocity=True)

    def _note_loss(self, stamp_ns: int) -> None:
        if self.lost_since_ns is None:
            self.lost_since_ns = stamp_ns
            held_since_ns = self._held_since_ns
            self.held_ns = stamp_ns - held_since_ns if held_since_ns is not None else 0
            self._held_since_ns = None

    def _retire(self, runner: Runner | None, session: int | None) -> None:
        if runner is None:
            return
        legacy = runner.retire()
        if session is not None:
            self._atlas.close_session(session, legacy.layers, legacy.trajectory)
