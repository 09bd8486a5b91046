"""The active module and its place in the map: tracking, bridging, and what a hand-over changes."""

from __future__ import annotations

import logging

import numpy as np

from sceneslam.atlas.atlas import BRIDGED, Atlas
from sceneslam.bus.bridge import Bridge
from sceneslam.bus.decision import Health
from sceneslam.bus.events import EventLog
from sceneslam.bus.handover import Handover
from sceneslam.bus.handover_log import log_cost
from sceneslam.bus.hold import Hold
from sceneslam.bus.memory import Memory, Moment
from sceneslam.bus.pace import Pace
from sceneslam.bus.policy import Policy
from sceneslam.bus.runner import Runner
from sceneslam.types import se3
from sceneslam.types.errors import ModuleError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, TrackingStatus
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform

_log = logging.getLogger(__name__)


class Estimator:
    """Gives every observation one pose: the active module's, or a bridged one."""

    def __init__(
        self, *, policy: Policy, rig: Rig, atlas: Atlas, log: EventLog, has_choice: bool
    ) -> None:
        self.active: Runner | None = None
        self._policy, self._rig, self._atlas, self._log = policy, rig, atlas, log
        self.hold = self._new_hold()  # of the active module
        # The paper's hand-over knows the last pose of a module and nothing after it.
        is_bridged = policy.handover != "cold"
        horizon_s = policy.bridge_s if is_bridged else 0.0
        self._bridge = Bridge(velocity_horizon_s=horizon_s, uses_odometry=is_bridged)
        self._memory = Memory(
            span_s=policy.buffer_s if policy.handover == "rewind" else 0.0,
            limit_mb=policy.buffer_mb,
            keeps_sensors=has_choice,
        )
        self._sessions: list[int] = []  # of the active module, one for every time it was placed
        self._is_placed = False
        self._told: TrackingStatus | None = None  # what the log says of the active module

    @property
    def health(self) -> Health:
        """Return what the active module's pose is worth; FAILED where there is none."""
        if self.active is None or self.active.is_failed:
            return Health.FAILED
        if self.hold.unheld_since_ns is None:
            return Health.HELD
        if self.hold.is_suspect:
            return Health.SUSPECT
        return Health.LOST if self.hold.status is TrackingStatus.LOST else Health.SILENT

    @property
    def now_ns(self) -> int:
        """Return the stamp of the newest observation."""
        return self._memory.newest.stamp_ns

    def track(self, observation: Observation, *, by_velocity: bool) -> None:
        """Give the observation its pose; raises ModuleError when the module broke its promise.

        Where the module gives none, odometry bridges, or constant velocity if `by_velocity` or
        while the module's sensors are silent. The pose is the robot's in either case.
        """
        T_map_base: Transform | None = None
        fault: ModuleError | None = None
        try:
            T_map_base = self._ask(observation)
        except ModuleError as error:
            fault = error
        is_told = T_map_base is not None
        if not is_told:
            is_silent = self.hold.status is not TrackingStatus.LOST
            T_map_base = self._bridge.predict(
                observation, by_velocity=by_velocity or is_silent, turn=self.hold.turn
            )
        module = self.active.key if is_told and self.active is not None else BRIDGED
        if T_map_base is not None:
            self._atlas.add(observation.stamp_ns, T_map_base, module, self.hold.covariance)
        moment = Moment(
            observation=observation,
            T_map_base=T_map_base,
            module=module,
            bridge=self._bridge.copy(),
            turn=self.hold.turn,
            covariance=self.hold.covariance,
            is_trusted=is_told and self.hold.is_trusted,
        )
        self._memory.add(moment)
        if fault is not None:
            raise fault

    def begin(
        self, runner: Runner, scene: str, since_ns: int | None, *, is_trial: bool = False
    ) -> Handover:
        """Begin to hand over to a module; raises ModuleError when it cannot be activated.

        `since_ns`: when the scene that calls for it began, None where it is not the scene. A
        trial begins now, whatever the kind of hand-over.
        """
        anchor = self._memory.newest
        if self._policy.handover == "rewind" and not is_trial:
            anchor = self._memory.anchor(since_ns)
        hold, pace = self._new_hold(), Pace(self._policy.catch_up)
        return Handover(
            runner, self._memory, anchor=anchor, hold=hold, pace=pace, scene=scene, rig=self._rig
        )

    def settle(self, handover: Handover) -> None:
        """Place a module that was on trial at the pose of now: what it gave before is not used."""
        handover.settle(self._memory.newest)

    def accept(self, handover: Handover) -> None:
        """Make a module that has caught up the active one, and shut the old one down."""
        old, old_sessions = self.active, self._sessions
        self.active, self.hold, self._told = handover.runner, handover.hold, None
        self._sessions, self._is_placed = [], False
        if handover.is_placed:
            self._rewrite(handover)
        self._tell(self._memory.newest.stamp_ns)
        log_cost(self._log, handover, self._memory.newest.stamp_ns)
        self._retire(old, old_sessions)

    def retire(self) -> None:
        """Shut the active module down and keep its map."""
        self._retire(self.active, self._sessions)
        self.active, self._sessions, self._is_placed = None, [], False

    def close(self) -> None:
        """Shut the active module down for good, and forget what was observed."""
        self.retire()
        self._memory.clear()

    def _ask(self, observation: Observation) -> Transform | None:
        """Return the active module's pose in the map, None where it holds none."""
        if self.active is None or self.active.is_failed:
            return None
        tracking = self.hold.ask(self.active, observation)
        self._tell(observation.stamp_ns)
        if self.hold.suspect_since_ns is not None:
            self._distrust(self.hold.suspect_since_ns, observation.stamp_ns)
        if tracking is None:
            return None
        if not self._is_placed:
            self._bridge.predict(observation, by_velocity=True)
            self._place(observation, tracking.T_local_base)
        assert self.active.T_map_local is not None
        T_map_base = self.active.T_map_local @ tracking.T_local_base
        self._bridge.update(observation, T_map_base, is_jump=self.hold.is_revised)
        self._atlas.add_local(observation.stamp_ns, tracking.T_local_base)
        return T_map_base

    def _distrust(self, since_ns: int, stamp_ns: int) -> None:
        """Bridge what a module told since it may have been wrong; it is placed anew later."""
        self._is_placed = False
        self._log.add("suspect", stamp_ns, module=self.active.key if self.active else "")
        untrusted = self._memory.after(since_ns)
        before = self._memory.last_until(since_ns)
        if before is None or not untrusted:
            return
        bridge, bridged = before.bridge.copy(), []
        for moment in untrusted:
            T_map_base = bridge.predict(moment.observation, by_velocity=False, turn=moment.turn)
            bridged.append(moment.bridged(T_map_base, bridge.copy()))
        self._atlas.rewind(untrusted[0].stamp_ns)
        self._put(bridged, stamp_ns)

    def _put(self, moments: list[Moment], stamp_ns: int) -> None:
        """Put moments that are better known now in the place of those that were told."""
        for moment in moments:
            if moment.T_map_base is not None:
                told = (moment.T_map_base, moment.module, moment.covariance)
                self._atlas.add(moment.stamp_ns, *told)
        if moments:
            self._memory.rewrite(moments)
        if len(moments) > 1:
            from_ns = moments[0].stamp_ns
            self._log.add("revised", stamp_ns, from_ns=from_ns, poses=len(moments))
        self._bridge = self._memory.newest.bridge.copy()

    def _place(self, observation: Observation, T_local_base: Transform) -> None:
        """Place a module that was not held when it became active (Eq. 1)."""
        assert self.active is not None
        self.active.place(self._bridge.T_map_base @ se3.inverse(T_local_base))
        self._begin_session(observation.stamp_ns, observation.stamp_ns, jump=se3.identity())

    def _rewrite(self, handover: Handover) -> None:
        """Put the poses of a module that has caught up in the place of the untrusted ones."""
        newest = self._memory.newest
        told, known = newest.T_map_base, handover.T_map_base
        jump = se3.identity() if told is None or known is None else se3.inverse(told) @ known
        keeps_anchor = handover.anchor.module != BRIDGED
        self._atlas.rewind(handover.anchor.stamp_ns + keeps_anchor)
        self._begin_session(newest.stamp_ns, handover.tracked[0].stamp_ns, jump=jump)
        for tracking in handover.tracked:
            self._atlas.add_local(tracking.stamp_ns, tracking.T_local_base)
        self._put(handover.trail, newest.stamp_ns)

    def _begin_session(self, stamp_ns: int, from_ns: int, *, jump: Transform) -> None:
        """Open the active module's session, which begins at `from_ns`.

        `jump` is how the pose that was told at `stamp_ns` differs from the one now known.
        """
        assert self.active is not None and self.active.T_map_local is not None
        T_map_local, last_ns = self.active.T_map_local, self._atlas.last_stamp_ns
        session = self._atlas.begin_session(self.active.key, T_map_local)
        self._sessions.append(session)
        self._is_placed = True
        self._log.add(
            "handover",
            stamp_ns,
            session=session,
            module=self.active.key,
            kind=self._policy.handover,
            from_ns=from_ns,
            T_map_local=T_map_local.tolist(),
            jump_m=float(np.linalg.norm(jump[:3, 3])),
            jump_rad=float(se3.rotation_angle_rad(jump)),
            gap_s=0.0 if last_ns is None else (from_ns - last_ns) / 1e9,
        )

    def _tell(self, stamp_ns: int) -> None:
        """Log the active module's status where it changed."""
        status = self.hold.status
        if status is None or status is self._told or self.active is None:
            return
        self._told = status
        self._log.add("tracking", stamp_ns, module=self.active.key, status=status.value)

    def _retire(self, runner: Runner | None, sessions: list[int]) -> None:
        """Shut a module down; its map lies where it was placed last."""
        if runner is None:
            return
        legacy = runner.retire()
        for session in sessions:
            layers = legacy.layers if session == sessions[-1] else MapLayers()
            self._atlas.close_session(session, layers, legacy.trajectory)

    def _new_hold(self) -> Hold:
        gate = self._policy.gate if self._policy.handover != "cold" else None
        return Hold(silence_ns=round(self._policy.lost_patience_s * 1e9), gate=gate)
