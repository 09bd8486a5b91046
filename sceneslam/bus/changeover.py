"""Carry out a decision: start the candidates in turn until one of them can take over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

from sceneslam.bus.decision import DOUBLINGS, Decision, Situation, StandbyTrial
from sceneslam.bus.estimator import Estimator
from sceneslam.bus.handover import Handover
from sceneslam.bus.judging.hold import Health
from sceneslam.bus.judging.runner import Runner
from sceneslam.bus.policy import Policy
from sceneslam.storage.events import EventLog
from sceneslam.types.errors import ModuleError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig

_LOSSES = (Health.LOST, Health.SILENT, Health.SUSPECT)  # reasons that may pass
_TRIAL_NS = 1_000_000_000  # the first choice tracks this long on standby before it takes over again


class Outcome(Enum):
    """What a state reports to the state machine: success (S) or failure (F) in the paper."""

    SUCCESS = "success"
    FAILURE = "failure"


class Candidates:
    """The table scene -> modules, and which of the served scene's modules were tried."""

    def __init__(
        self,
        scenes: Mapping[str, Sequence[str]],
        runners: Mapping[str, Runner],
        retry_s: float,
        *,
        waits: bool,
    ) -> None:
        self.scene = ""  # the confirmed scene that the active module serves
        self.tried: frozenset[str] = frozenset()
        self.rounds = 0  # how often all candidates were tried and failed
        self.retry_ns = 0  # when the first choice may be tried again
        self._scenes, self._runners, self._waits = scenes, runners, waits
        self._retry_ns, self._retries = round(retry_s * 1e9), 0

    def of(self, scene: str) -> tuple[str, ...]:
        """Return the modules of a scene that can run, in the table's order.

        Modules that must be waited for are included where waiting is allowed.
        """
        if self._waits:
            return self.returning(scene)
        return tuple(key for key in self._scenes.get(scene, ()) if self._runners[key].can_run)

    def returning(self, scene: str) -> tuple[str, ...]:
        """Return the modules of a scene that can run, now or later."""
        return tuple(key for key in self._scenes.get(scene, ()) if self._runners[key].may_return)

    @property
    def may_return(self) -> bool:
        """Tell whether any scene has a module that can run, now or later."""
        return any(self.returning(scene) for scene in self._scenes)

    def serve(self, scene: str, keys: Sequence[str], rounds: int) -> None:
        """Set the served scene; of its modules only `keys` may be tried."""
        if scene != self.scene:
            self._retries = 0
        self.scene, self.rounds = scene, rounds
        self.tried = frozenset(self._scenes.get(scene, ())) - frozenset(keys)

    def use(self, key: str) -> None:
        """Note that a module is being tried."""
        self.tried |= {key}

    def postpone(self, stamp_ns: int, *, is_in_vain: bool | None) -> None:
        """Delay the next trial of the first choice, for longer after each trial that failed.

        `is_in_vain` is None where that is not known.
        """
        if is_in_vain is not None:
            self._retries = self._retries + 1 if is_in_vain else 0
        self.retry_ns = stamp_ns + (self._retry_ns << min(self._retries, DOUBLINGS))


@dataclass(slots=True, kw_only=True)
class _Attempt:
    """A candidate that is being started."""

    runner: Runner
    since_ns: int  # when it became a candidate
    ready_ns: int  # when it may be started
    is_trial: bool = False  # it began on standby beside the fallback
    is_begun: bool = False  # it is being started, or was
    handover: Handover | None = None  # None until it has started
    from_ns: int | None = None  # it begins anew with this observation


class Changeover:
    """Goes through a decision's candidates; offline at once, live a few observations at a time."""

    def __init__(
        self,
        *,
        runners: Mapping[str, Runner],
        candidates: Candidates,
        estimator: Estimator,
        policy: Policy,
        rig: Rig,
        log: EventLog,
        catch_up_steps: int | None,
    ) -> None:
        self._runners, self._candidates, self._estimator = runners, candidates, estimator
        self._policy, self._rig, self._log, self._limit = policy, rig, log, catch_up_steps
        self._run_began_ns: int | None = None
        self._now: Situation  # at the decision that is carried out
        self._verdict: Decision
        self._since_ns: int | None  # when the scene that calls for it began
        self.queue: list[str] = []  # its candidates that were not tried yet
        self._order: tuple[str, ...] = ()  # all of them, the best first
        self._attempts: list[_Attempt] = []  # best first
        self._trial: _Attempt | None = None

    @property
    def trial(self) -> StandbyTrial:
        """Return the state of the scene's first choice, on standby beside the fallback."""
        if self._trial is None:
            return StandbyTrial.NONE
        return StandbyTrial.PASSED if self._tracked_ns >= _TRIAL_NS else StandbyTrial.RUNNING

    @property
    def is_first(self) -> bool:
        """Tell whether the change is to the first module of the run."""
        return self._verdict.reason == "first"

    @property
    def _tracked_ns(self) -> int:
        """Return how long the module on trial has tracked, 0 without one."""
        handover = None if self._trial is None else self._trial.handover
        return 0 if handover is None else handover.tracked_ns(self._estimator.now_ns)

    def begin(self, now: Situation, verdict: Decision, since_ns: int | None) -> None:
        """Begin to change the module.

        `since_ns`: when the scene that calls for it began, None for another reason.
        """
        self._now, self._verdict, self._since_ns = now, verdict, since_ns
        self.queue = list(verdict.to)
        if self._trial is not None:
            key, is_starting = self._trial.runner.key, self._trial.handover is None
            is_ready = self._tracked_ns > 0 and key in verdict.to[:1]
            if verdict.reason == "scene" or not (is_ready or is_starting):
                self._drop_trial()  # a scene begins in the past
            elif key not in self.queue:
                self.queue.append(key)  # it starts already
        self._order = tuple(self.queue)

    def go_on(self) -> Outcome | None:
        """Advance the change by one candidate or one observation; return None until it is over.

        Beside one that keeps a lost robot waiting while it starts, the next starts as well; the
        first that can takes over.
        """
        if self._is_back():
            self._end_hurry()
        while self._attempts or self.queue:
            if (not self._attempts or self._is_late()) and not self._start_next():
                break
            for attempt in sorted(self._attempts, key=lambda one: one.handover is None):
                is_accepted = self._lead(attempt)
                if is_accepted is None and attempt.handover is not None:
                    return None  # one at a time catches up
                if is_accepted is None:
                    continue
                self._attempts.remove(attempt)
                key = attempt.runner.key
                if is_accepted:
                    self._leave_others()
                    is_best = self.is_first or key == self._verdict.to[0]
                    return Outcome.SUCCESS if is_best else Outcome.FAILURE
                if self.is_first:
                    return Outcome.FAILURE  # the machine enters `start` again, with the next one
            if self._attempts:
                return None
        active = self._estimator.active
        if active is not None and active.is_failed:
            self._estimator.retire()
        elif active is not None and self._verdict.reason == "scene":
            self.tell_scene()
        return Outcome.FAILURE

    def why_over(self, scene: str) -> str:
        """Return why the change that has begun is wanted no longer, now in a scene; "" if it is.

        Another scene calls for another first choice, and the old module tracks or it does not want
        the module that starts at all; or the loss is over: the old module has tracked for as long
        as it may be lost.
        """
        if not self._attempts:
            return ""
        if self._verdict.reason in _LOSSES and self._is_back():
            return "the module tracks again"
        is_held = self._estimator.session.health is Health.HELD
        choices = self._candidates.of(scene)
        if scene == self._candidates.scene or not choices or choices[:1] == self._verdict.to[:1]:
            return ""
        is_useless = all(attempt.runner.key not in choices for attempt in self._attempts)
        return "the scene is over" if is_held or is_useless else ""

    def give_up(self, why: str) -> None:
        """End the change; the active module stays."""
        self.queue = []
        for attempt in self._attempts:
            self._log_choice("refused", attempt.runner.key, why=why)
        self._end_attempts()

    def tell_scene(self) -> None:
        """Inform the active module, which stays, of the scene that it serves now."""
        assert self._estimator.active is not None
        try:
            self._estimator.active.set_scene(self._candidates.scene)
        except ModuleError as error:
            self._log.add_fault(self._estimator.now_ns, str(error))

    def begin_trial(self, key: str) -> None:
        """Run the scene's first choice on standby beside the fallback; its poses are not used."""
        self._trial = self._new_attempt(self._runners[key], is_trial=True)
        self.try_on()

    def submit(self, observation: Observation) -> None:
        """Submit an observation to the module on trial, which runs beside the active one."""
        if self._trial is None or self._trial.handover is None:
            return
        try:
            self._trial.runner.submit(observation)
        except ModuleError as error:
            self._log.add_fault(observation.stamp_ns, str(error))
            self._end_trial()

    def try_on(self) -> None:
        """Feed the module on trial until it fails, stays lost or is the first choice no longer."""
        trial = self._trial
        if trial is None:
            return
        if not self._is_first_choice(trial) and not trial.runner.is_failed:
            self._drop_trial()
            return
        try:
            handover = self._caught_up(trial)
        except ModuleError as error:
            self._log.add_fault(self._estimator.now_ns, str(error))
            self._end_trial()
            return
        if handover is None:
            return
        handover.trail, handover.tracked = [], []  # on trial its poses are not the robot's
        waited_ns = self._estimator.now_ns - handover.began_ns  # it may need motion
        if handover.fault and waited_ns >= self._policy.retry_s * 1e9:
            self._end_trial()

    def close(self) -> None:
        """Shut down every module that is being started."""
        self._drop_trial()
        self._end_attempts()

    def _end_attempts(self) -> None:
        for attempt in self._attempts:
            attempt.runner.retire()
        self._attempts = []

    def _end_hurry(self) -> None:
        """End the attempts beside the first: they are candidates again, each in its turn."""
        while len(self._attempts) > 1:
            runner = self._attempts.pop().runner
            runner.retire()
            self.queue.append(runner.key)
            self.queue.sort(key=self._order.index)

    def _is_back(self) -> bool:
        """Tell whether the active module has tracked for as long as it may be lost."""
        session, now_ns = self._estimator.session, self._estimator.now_ns
        since_ns = session.hold.held_since_ns
        if session.health is not Health.HELD or since_ns is None:
            return False
        return now_ns - since_ns >= session.hold.patience_ns

    def _leave_others(self) -> None:
        """End the attempts that another was quicker than; the first choice starts on standby."""
        first = next(filter(self._is_first_choice, self._attempts), None)
        if first is not None and first.handover is None and self._trial is None:
            first.is_trial, self._trial = True, first
            self._attempts.remove(first)
        self._end_attempts()

    def _is_first_choice(self, attempt: _Attempt) -> bool:
        first = self._candidates.of(self._candidates.scene)[:1]
        return first == (attempt.runner.key,)

    def _is_late(self) -> bool:
        """Tell whether the newest candidate has left the robot lost for too long while it starts.

        Then another may take over sooner. The paper's (cold) hand-over waits.
        """
        hold = self._estimator.session.hold
        is_waited_for = self.is_first or any(one.handover is not None for one in self._attempts)
        if is_waited_for or self._policy.handover == "cold" or hold.unheld_since_ns is None:
            return False
        since_ns = max(hold.unheld_since_ns, self._attempts[-1].since_ns)
        lost_ns = self._estimator.now_ns - since_ns
        return bool(self._inactive()) and lost_ns >= hold.patience_ns

    def _inactive(self) -> list[str]:
        """Return the candidates that wait, but for the active module."""
        return [key for key in self.queue if self._runners[key] is not self._estimator.active]

    def _start_next(self) -> bool:
        """Begin to start the next candidate; return whether there is one but the active module."""
        key = (self._inactive() if self._attempts else self.queue)[0]
        self.queue.remove(key)
        runner, from_ns = self._runners[key], None
        if runner is self._estimator.active:
            from_ns = self._estimator.session.hold.adrift_since_ns
            is_adrift = self._verdict.reason == Health.LOST and from_ns is not None
            if not runner.is_failed and not is_adrift:
                return False  # it stays, as the fallback
            self._estimator.retire()  # before it is started again
        attempt = self._start(runner)
        attempt.from_ns = from_ns
        self._attempts.append(attempt)
        return True

    def _start(self, runner: Runner) -> _Attempt:
        """Begin to start a module, which may take seconds."""
        self._candidates.use(runner.key)
        if self._trial is not None and self._trial.runner is runner:
            attempt, self._trial = self._trial, None
            attempt.since_ns, attempt.is_trial = self._estimator.now_ns, bool(attempt.handover)
            return attempt
        attempt = self._new_attempt(runner)
        if self._policy.handover == "cold" and attempt.ready_ns > self._estimator.now_ns:
            self._estimator.retire()  # the paper shuts a module down before it starts the next
        return attempt

    def _new_attempt(self, runner: Runner, *, is_trial: bool = False) -> _Attempt:
        now_ns, ready_ns = self._estimator.now_ns, self._ready_ns(runner.key)
        return _Attempt(runner=runner, since_ns=now_ns, ready_ns=ready_ns, is_trial=is_trial)

    def _lead(self, attempt: _Attempt) -> bool | None:
        """Advance one candidate; return whether it took over, None while undecided."""
        T_new_old = self._estimator.session.T_new_old
        try:
            if T_new_old is not None and attempt.handover is not None:
                attempt.handover.move(T_new_old)
            handover = self._caught_up(attempt)
            if handover is not None and attempt.is_trial:
                handover.settle()
        except ModuleError as error:
            self._log.add_fault(self._estimator.now_ns, str(error))
            return self._refuse(attempt.runner, "failed")
        if handover is None:
            return None
        if handover.fault and self._can_refuse():
            return self._refuse(attempt.runner, handover.fault)
        if handover.is_unheard and self._estimator.session.hold.is_held and self._can_refuse():
            return None  # it may be that its sensors give nothing
        self._estimator.accept(handover)
        is_in_vain = None
        if self._now.active and self._now.health is not Health.HELD:  # what it leaves has ended
            is_in_vain = self._now.held_ns < round(self._policy.confirm_window_s * 1e9)
        self._candidates.postpone(self._estimator.now_ns, is_in_vain=is_in_vain)
        self._log_choice("decision", attempt.runner.key)
        return True

    def _caught_up(self, attempt: _Attempt) -> Handover | None:
        """Start or advance a candidate; return its hand-over once it has caught up."""
        if self._estimator.now_ns < attempt.ready_ns:
            return None
        runner, is_trial = attempt.runner, attempt.is_trial
        if not attempt.is_begun:
            attempt.is_begun = True
            runner.start(self._rig, self._candidates.scene)
        if attempt.handover is None:
            if not runner.has_started():
                return None
            attempt.handover = self._estimator.begin(
                runner, self._since_ns, is_trial=is_trial, from_ns=attempt.from_ns
            )
        has_caught_up = attempt.handover.advance(None if is_trial else self._limit)
        return attempt.handover if has_caught_up else None

    def _can_refuse(self) -> bool:
        """Tell whether there is an alternative to a lost module; the paper has no such check."""
        others = bool(self.queue) or len(self._attempts) > 1
        has_other = others or self._estimator.session.hold.is_held
        return has_other and self._policy.handover != "cold"

    def _refuse(self, runner: Runner, why: str) -> bool:
        runner.retire()
        self._candidates.postpone(self._estimator.now_ns, is_in_vain=True)
        self._log_choice("refused", runner.key, why=why)
        return False

    def _log_choice(self, event: str, key: str, **more: str) -> None:
        self._log.add(
            event,
            self._estimator.now_ns,
            scene=self._candidates.scene,
            **{"from": self._now.active or None, "to": key},
            reason=self._verdict.reason,
            decided_ns=self._now.stamp_ns,
            **more,
        )

    def _end_trial(self) -> None:
        self._candidates.postpone(self._estimator.now_ns, is_in_vain=True)
        self._drop_trial()

    def _drop_trial(self) -> None:
        if self._trial is not None:
            self._trial.runner.retire()
        self._trial = None

    def _ready_ns(self, key: str) -> int:
        """Return when a module that is started now can take its first observation."""
        now_ns = self._estimator.now_ns
        if self._run_began_ns is None:
            self._run_began_ns = now_ns
        startup_ns = round(self._policy.startup_s.get(key, 0.0) * 1e9)
        if self._policy.handover == "warm":
            return max(now_ns, self._run_began_ns + startup_ns)  # loaded when the run began
        return now_ns + startup_ns
