"""The active session and the remembered trajectory, which a hand-over may rewrite."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace

import numpy as np

from sceneslam.bus.bridge import Bridge
from sceneslam.bus.handover import Handover
from sceneslam.bus.judging.gate import Gate, Witness
from sceneslam.bus.judging.hold import Hold
from sceneslam.bus.judging.runner import Legacy, Runner
from sceneslam.bus.observation_buffer import BufferedObservation, ObservationBuffer, bridged
from sceneslam.bus.pace import Pace
from sceneslam.bus.policy import Policy
from sceneslam.bus.session import ModuleSession, Suspicion
from sceneslam.interfaces import BackEnd
from sceneslam.storage.events import EventLog
from sceneslam.types import se3
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.run import BRIDGED
from sceneslam.types.se3 import Transform


class Estimator:
    """Gives every observation one pose, and reports it to the back end and the log."""

    def __init__(
        self, *, policy: Policy, rig: Rig, back_end: BackEnd, log: EventLog, has_choice: bool
    ) -> None:
        self._policy, self._rig, self._back_end, self._log = policy, rig, back_end, log
        # The active module's; the paper's (cold) hand-over uses its last pose and nothing after it.
        bridge = Bridge(is_active=policy.handover != "cold")
        self.session = self._new_session(None, bridge, lie_until_ns=-1)
        self._memory = ObservationBuffer(  # of the newest observation alone, unless it rewinds
            span_s=policy.buffer_s if policy.handover == "rewind" else 0.0,
            limit_mb=policy.buffer_mb,
            keeps_sensors=has_choice,
        )
        # Modules that are being shut down, each with its sessions in the back end.
        self._ending: list[tuple[Future[Legacy], list[int]]] = []
        self._told_lie = False  # whether the wheels were last logged as wrong

    @property
    def active(self) -> Runner | None:
        """Return the active module, None while no module is active."""
        return self.session.runner

    @property
    def now_ns(self) -> int:
        """Return the stamp of the newest observation."""
        return self._memory.newest.stamp_ns

    def track(self, observation: Observation, witness: Witness, *, by_velocity: bool) -> None:
        """Give the observation its pose; if the module violates its contract, log that.

        `witness` says what is known of the odometry without the module.
        """
        self._keep_maps(waits=False)
        session, was_placed = self.session, self.session.is_placed
        moment = session.advance(observation, by_velocity=by_velocity, witness=witness)
        self._tell(observation.stamp_ns)
        if session.T_new_old is not None and was_placed:
            self._memory.move(session.T_new_old, session.from_ns)
        if session.hold.suspect_since_ns is not None and session.fault is None:
            since_ns = max(session.hold.suspect_since_ns, session.from_ns)
            if was_placed:
                session.suspicion = Suspicion(since_ns=since_ns, noticed_ns=moment.stamp_ns)
            moment = self._distrust(since_ns, moment)
        if session.tracking is not None:
            if session.suspicion is not None and session.is_acquitted:
                moment = self._acquit(session.suspicion, moment)
            elif not was_placed:
                now_ns = moment.stamp_ns
                self._begin_session(now_ns, now_ns, posed_ns=now_ns, jump=se3.identity())
            session.suspicion = None
            self._back_end.add_local(moment.stamp_ns, session.tracking.T_local_base)
        self._report(moment)
        self._memory.add(moment)
        if session.fault is not None:
            self._log.add_fault(moment.stamp_ns, str(session.fault))

    def begin(
        self, runner: Runner, since_ns: int | None, *, is_trial: bool, from_ns: int | None = None
    ) -> Handover:
        """Begin to hand over to a module that has started.

        `since_ns`: when the scene that calls for it began, None for another reason. A trial begins
        now, whatever the kind of hand-over. `from_ns`: the first observation that it gets, where
        none before it is of use.
        """
        anchor = self._memory.newest if is_trial else self._memory.anchor(since_ns)
        if from_ns is not None:
            anchor = self._memory.after(from_ns - 1)[0]
        lie_until_ns = self.session.hold.lie_until_ns
        session = self._new_session(runner, anchor.bridge.copy(), lie_until_ns=lie_until_ns)
        return Handover(session, self._memory, anchor=anchor, pace=Pace(self._policy.catch_up))

    def accept(self, handover: Handover) -> None:
        """Make a module that has caught up the active one, and shut the old one down."""
        old, self.session = self.session, handover.session
        self.session.bridge, self.session.from_ns = old.bridge, handover.anchor.stamp_ns
        hold = self.session.hold  # what it was lost for in what it caught up on does not count
        hold.unheld_since_ns = None if hold.unheld_since_ns is None else self.now_ns
        hold.adrift_since_ns = None if hold.adrift_since_ns is None else self.now_ns
        if self.session.is_placed:
            self._rewrite(handover)
        self._tell(self.now_ns)
        self._log.add("cost", self.now_ns, **handover.cost(self.now_ns))
        self._retire(old)

    def retire(self) -> None:
        """Shut the active module down and keep its map."""
        old = self.session
        self._retire(old)
        self.session = self._new_session(None, old.bridge, lie_until_ns=old.hold.lie_until_ns)

    def close(self) -> None:
        """Shut the active module down, and delete the buffered observations."""
        self.retire()
        self._keep_maps(waits=True)
        self._memory.clear()

    def _distrust(self, since_ns: int, moment: BufferedObservation) -> BufferedObservation:
        """Replace the poses after `since_ns` by bridged ones; return the newest one, bridged."""
        self._log.add("suspect", moment.stamp_ns, module=self.session.key)
        untrusted, before = self._memory.after(since_ns), self._memory.last_until(since_ns)
        if before is None or not untrusted:
            return moment
        return self._retell(bridged(before, [*untrusted, moment]), before.T_new_told)

    def _acquit(self, suspicion: Suspicion, moment: BufferedObservation) -> BufferedObservation:
        """Take the remembered poses of a suspicion from the module after all.

        Where it gave no answer, they are interpolated. Return the newest one, with its bridge.
        """
        since_ns = max(suspicion.since_ns, self._memory.oldest_ns)
        before, runner = self._memory.last_until(since_ns), self.active
        assert before is not None and runner is not None and runner.T_map_local is not None
        moments = [*self._memory.after(since_ns), moment]
        first = next(each.tracking for each in moments if each.tracking is not None)
        if before.tracking is not None and before.tracking.revision == first.revision:
            before = replace(before)
            before.move(se3.inverse(before.T_new_told))  # as told; so are the next answers
        bridge, told = before.bridge.copy(), list[BufferedObservation]()
        missed, last = list[BufferedObservation](), before
        for each in moments:
            answer = each.tracking
            if answer is None:
                missed.append(each)
                continue
            T_map_base = runner.T_map_local @ answer.T_local_base
            for one in missed:
                share = (one.stamp_ns - last.stamp_ns) / (each.stamp_ns - last.stamp_ns)
                T_map_last = T_map_base if last.T_map_base is None else last.T_map_base
                T_last_base = se3.inverse(T_map_last) @ T_map_base
                T_map_one = T_map_last @ se3.exp(share * se3.log(T_last_base))
                bridge.follow(one.observation, se3.inverse(bridge.T_map_base) @ T_map_one)
                told.append(replace(one, T_map_base=T_map_one, bridge=bridge.copy()))
            is_jump = last.tracking is not None and last.tracking.revision != answer.revision
            bridge.update(each.observation, T_map_base, is_jump=is_jump)
            last = replace(each, T_map_base=T_map_base, module=runner.key, bridge=bridge.copy())
            if suspicion.noticed_ns <= each.stamp_ns < moment.stamp_ns:  # its answer was kept back
                last = replace(last, tracking=self.session.doubted(answer))
                self._back_end.add_local(each.stamp_ns, answer.T_local_base)
            told.append(last)
            missed = []
        return self._retell(told, before.T_new_told)

    def _retell(
        self, moments: list[BufferedObservation], T_new_told: Transform
    ) -> BufferedObservation:
        """Replace the last poses, the newest of which was not told yet; return that.

        `T_new_told` (4, 4) is the correction of the pose before them.
        """
        self._back_end.rewind(moments[0].stamp_ns, T_new_told)
        self._put(moments[:-1], moments[-1].stamp_ns)
        self.session.bridge = moments[-1].bridge.copy()
        return moments[-1]

    def _put(self, moments: list[BufferedObservation], stamp_ns: int) -> None:
        """Replace buffered observations by those with corrected poses."""
        for moment in moments:
            self._report(moment)
        if moments:
            self._memory.rewrite(moments)
        if len(moments) > 1:
            from_ns = moments[0].stamp_ns
            self._log.add("revised", stamp_ns, from_ns=from_ns, poses=len(moments))

    def _report(self, moment: BufferedObservation) -> None:
        """Report a pose to the back end."""
        moment.T_new_told = se3.identity()
        if moment.T_map_base is not None:
            known = None if moment.module == BRIDGED else moment.tracking
            self._back_end.add(
                moment.stamp_ns,
                moment.T_map_base,
                moment.module,
                None if known is None else known.covariance,
                None if known is None else known.map_covariance,
            )

    def _rewrite(self, handover: Handover) -> None:
        """Replace the untrusted poses by those of a module that has caught up."""
        newest, trail = self._memory.newest, handover.trail
        before, known = newest.T_map_base, (trail or [handover.anchor])[-1].T_map_base
        jump = se3.identity() if before is None or known is None else se3.inverse(before) @ known
        if trail:
            self._back_end.rewind(trail[0].stamp_ns)
        from_ns = handover.tracked[0].stamp_ns
        posed_ns = min([from_ns, *(one.stamp_ns for one in trail if one.T_map_base is not None)])
        anchor, kept = handover.anchor, self._memory.last_until(handover.anchor.stamp_ns)
        if kept is not None and kept.module != anchor.module:
            anchor = kept  # a suspicion has replaced its pose since
        moved = anchor.T_new_told
        self._begin_session(newest.stamp_ns, from_ns, posed_ns=posed_ns, jump=jump, moved=moved)
        for tracking in handover.tracked:
            self._back_end.add_local(tracking.stamp_ns, tracking.T_local_base)
        self._put(trail, newest.stamp_ns)
        self.session.bridge = self._memory.newest.bridge.copy()

    def _begin_session(
        self,
        stamp_ns: int,
        from_ns: int,
        *,
        posed_ns: int,
        jump: Transform,
        moved: Transform | None = None,
    ) -> None:
        """Open the active module's session in the back end; it begins at `from_ns`.

        Its first pose, bridged or not, has the stamp `posed_ns`.
        `jump` is the transform from the pose reported at `stamp_ns` to the corrected one,
        `moved` the correction T_new_told of the pose from which it begins.
        """
        assert self.active is not None and self.active.T_map_local is not None
        T_map_local, last_ns = self.active.T_map_local, self._back_end.last_stamp_ns
        session = self._back_end.begin_session(self.active.key, T_map_local, moved)
        self.session.stored.append(session)
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
            gap_s=0.0 if last_ns is None else (posed_ns - last_ns) / 1e9,
        )

    def _tell(self, stamp_ns: int) -> None:
        """Log changes of the active module's status and of whether the wheels are trusted."""
        if self.session.hold.wheels_lie is not self._told_lie:
            self._told_lie = self.session.hold.wheels_lie
            self._log.add("odometry", stamp_ns, is_believed=not self._told_lie)
        status = self.session.hold.status
        if status is not None and status is not self.session.logged:
            self.session.logged = status
            self._log.add("tracking", stamp_ns, module=self.session.key, status=status.value)

    def _retire(self, session: ModuleSession) -> None:
        """Shut a module down; its map stays where it was placed last."""
        if session.runner is not None:
            self._ending.append((session.runner.retire(), session.stored))
            self._keep_maps(waits=False)

    def _keep_maps(self, *, waits: bool) -> None:
        """Pass the maps of modules that have shut down to the back end.

        `waits`: wait for modules that are still shutting down.
        """
        while self._ending and (waits or self._ending[0][0].done()):
            ended, stored = self._ending.pop(0)
            legacy = ended.result()
            if legacy.lost and stored:
                self._log.add("fault", self.now_ns, what=legacy.lost)
            for session in stored:
                layers = legacy.layers if session == stored[-1] else MapLayers()
                self._back_end.close_session(session, layers, legacy.trajectory)

    def _new_session(
        self, runner: Runner | None, bridge: Bridge, *, lie_until_ns: int
    ) -> ModuleSession:
        settings, wheels = self._policy.gate, self._rig.wheels
        gate = None if settings is None else Gate(settings, wheels, lie_until_ns=lie_until_ns)
        hold = Hold(patience_ns=round(self._policy.lost_patience_s * 1e9), gate=gate)
        return ModuleSession(runner, hold, bridge)
