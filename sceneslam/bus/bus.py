"""The bus: asks the detector, drives the state machine, and runs the module the scene calls for."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter_ns

from statemachine import State, StateMachine

from sceneslam.bus.changeover import Candidates, Changeover, Outcome
from sceneslam.bus.decision import BLIND, GO_ON, Action, Decision, Situation, decide, in_json
from sceneslam.bus.estimator import Estimator
from sceneslam.bus.judging.dead_reckoning import DeadReckoning
from sceneslam.bus.judging.hold import Health
from sceneslam.bus.judging.runner import Runner
from sceneslam.bus.policy import Policy
from sceneslam.bus.scene.watch import Watch
from sceneslam.executors import executor
from sceneslam.interfaces import BackEnd, Detector, SlamModule
from sceneslam.storage.events import EventLog
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Vector


class BusMachine(StateMachine):
    """Success and failure lead from state to state (Fig. 2); `stop` ends the run from anywhere.

    After a failure the owner's `candidate_left` and `fallback_active` tell what is possible. On
    entering a state its method `on_enter_STATE` is called, if it exists.
    """

    init = State(initial=True)
    start = State()
    run = State()
    switch = State()
    terminate = State(final=True)

    success = init.to(start) | start.to(run) | switch.to(run)
    failure = (
        init.to(terminate)
        | start.to(start, cond="candidate_left")
        | start.to(run, cond="fallback_active")  # without a module, while one may come back
        | start.to(terminate)
        | run.to(switch)
        | switch.to(run, cond="fallback_active")
        | switch.to(terminate)
    )
    stop = terminate.from_(init, start, run, switch)

    def __init__(self, owner: object) -> None:
        super().__init__(listeners=[owner])

    @property
    def state(self) -> str:
        """Return the name of the state the machine is in."""
        return str(next(iter(self.configuration)).id)


_Step = Callable[[Observation], Outcome | None]  # None: the state does not change


class Bus:
    """Feeds observations to the detector and the active module, one `step` at a time.

    `scenes` maps every scene to keys of `modules`: the one to run, then its fallbacks.
    `catch_up_steps`: how many remembered observations a new module processes per new observation;
    None: all at once. `is_live`: modules start and shut down in another thread.
    """

    def __init__(
        self,
        *,
        detector: Detector,
        modules: Mapping[str, SlamModule],
        scenes: Mapping[str, Sequence[str]],
        policy: Policy,
        rig: Rig,
        back_end: BackEnd,
        log: EventLog,
        catch_up_steps: int | None = None,
        is_live: bool = False,
    ) -> None:
        self.runners = {
            key: Runner(key, module, executor(key, is_live=is_live))
            for key, module in modules.items()
        }
        self.bus_us = array("d")
        if policy.handover == "cold":
            policy = replace(policy, gate=None)  # the paper has no such check
        self._policy, self._log = policy, log
        self._watch = Watch(
            detector, rig, log, scene_filter=policy.make_scene_filter(detector.scenes)
        )
        self.detector_us = self._watch.spent_us  # time that each vote took
        self._reckoning = DeadReckoning(rig, policy.gate)
        self._estimator = Estimator(
            policy=policy, rig=rig, back_end=back_end, log=log, has_choice=len(modules) > 1
        )
        waits = catch_up_steps is None  # a recording can wait for a module, a robot cannot
        self._candidates = Candidates(scenes, self.runners, policy.retry_s, waits=waits)
        self._changeover = Changeover(
            runners=self.runners,
            candidates=self._candidates,
            estimator=self._estimator,
            policy=policy,
            rig=rig,
            log=log,
            catch_up_steps=catch_up_steps,
        )
        self._situation: Situation | None = None  # at the last decision
        self._odom_ns: int | None = None  # stamp of the last odometry
        self.unserved: dict[str, str] = {}  # scenes whose modules all failed, and the last fault
        self._do: _Step  # what the state does with an observation
        self._go_on: _Step  # the same for the observation at which the state was entered
        self._machine = BusMachine(self)
        self.state = self._machine.state

    @property
    def active(self) -> str:
        """Return the key of the active module, "" when no module is active."""
        return self._estimator.session.key

    @property
    def beside(self) -> list[str]:
        """Return which modules start or end in another thread now, in words."""
        return [f"{key} {runner.beside}" for key, runner in self.runners.items() if runner.beside]

    @property
    def up_base(self) -> Vector | None:
        """Return the upward direction (3,) in base at the newest observation, None if unknown."""
        return self._reckoning.up_base

    @property
    def scene(self) -> str:
        """Return the scene that the active module serves, "" before the first."""
        return self._candidates.scene

    def step(self, observation: Observation) -> None:
        """Process one observation: vote, track, and change state if necessary."""
        began_ns = perf_counter_ns()
        spent_ns = self._spent_ns()
        self._watch.look(observation)
        observation = self._reckoning.correct(observation, self.active)
        self._changeover.submit(observation)
        if observation.T_odom_base is not None:
            self._odom_ns = observation.stamp_ns
        witness = self._reckoning.witness
        self._estimator.track(observation, witness, by_velocity=self._has_other())
        self._reckoning.learn(self._estimator.session.hold, self.active)
        outcome = self._do(observation)
        while outcome is not None:
            self._send(outcome.value, observation.stamp_ns)
            outcome = self._go_on(observation)
        own_ns = perf_counter_ns() - began_ns - (self._spent_ns() - spent_ns)
        self.bus_us.append(own_ns / 1e3 - self.detector_us[-1])

    def select(self, scene: str) -> None:
        """Take a scene for the one around the robot; "": as the detector votes."""
        self._watch.selected = scene

    def leave_awaited(self, stamp_ns: int) -> bool:
        """Leave out the module that a step waits for, and log it; return whether there is one."""
        awaited = [runner for runner in self.runners.values() if runner.is_awaited]
        for runner in awaited:
            runner.leave()
            what = "did not return from a call when the run was stopped, and its map is lost"
            self._log.add_fault(stamp_ns, f"slam.{runner.key} {what}")
        return bool(awaited)

    def close(self, stamp_ns: int) -> None:
        """End the run: shut the module down, then the detector. May be called twice."""
        if not self._machine.is_terminated:
            self._send("stop", stamp_ns)
        self._reckoning.close(stamp_ns, self._log)
        self._changeover.close()
        self._estimator.close()
        for runner in self.runners.values():
            runner.close()
        self._watch.close()

    # Conditions of the state machine's transitions after a failure.

    def candidate_left(self) -> bool:
        """Tell whether the scene has a module that has not been tried yet."""
        return bool(self._changeover.queue)

    def fallback_active(self) -> bool:
        """Tell whether a module other than the first choice runs, or one may run later."""
        return self._estimator.active is not None or self._candidates.may_return

    # Actions on entering a state.

    def on_enter_init(self) -> None:
        """Wait for the first confirmed scene."""
        self._do, self._go_on = self._await_scene, _wait

    def on_enter_start(self) -> None:
        """Start the scene's module, or the next candidate."""
        self._do = self._go_on = self._change_over

    def on_enter_run(self) -> None:
        """Track, until the scene calls for another module or the active one is unhealthy."""
        if self._estimator.active is None and not self._candidates.returning(self.scene):
            self.unserved.setdefault(self.scene, self._log.last_fault)
        self._do, self._go_on = self._decide, _wait

    def on_enter_switch(self) -> None:
        """Hand over to the next module."""
        self._do = self._go_on = self._change_over

    def on_enter_terminate(self) -> None:
        """Ignore all further observations."""
        self._do = self._go_on = _wait

    def _await_scene(self, observation: Observation) -> Outcome | None:
        if not self._watch.is_working and not self._watch.selected:
            return Outcome.FAILURE
        if self._watch.confirmed is None:
            return None
        now = self._look(observation)
        self._begin(now, Decision(action=Action.SWITCH, to=now.choices, reason="first"))
        return Outcome.SUCCESS

    def _change_over(self, observation: Observation) -> Outcome | None:
        confirmed = self._watch.confirmed
        why = "" if confirmed is None else self._changeover.why_over(confirmed.scene)
        if why:
            self._changeover.give_up(why)
            if self._estimator.active is not None:
                return Outcome.FAILURE
            now, reason = self._look(observation), "first" if self._changeover.is_first else "scene"
            self._begin(now, Decision(action=Action.SWITCH, to=now.choices, reason=reason))
        return self._changeover.go_on()

    def _decide(self, observation: Observation) -> Outcome | None:
        self._changeover.try_on()
        situation = self._look(observation)
        verdict = decide(self._policy, situation)
        if situation != self._situation or verdict != GO_ON:  # more than its time changed
            self._log.add("situation", **in_json(situation), verdict=in_json(verdict))
        self._situation = situation
        if verdict.action is Action.TELL:
            self._candidates.serve(situation.scene, situation.choices[1:], 0)
            self._changeover.tell_scene()
        elif verdict.action is Action.TRY:
            self._changeover.begin_trial(verdict.to[0])
        elif verdict.action is Action.SWITCH:
            self._begin(situation, verdict)
            return Outcome.FAILURE
        return None

    def _begin(self, now: Situation, verdict: Decision) -> None:
        """Begin to carry out a verdict."""
        confirmed = self._watch.confirmed if verdict.reason in ("first", "scene") else None
        scene = now.served_scene if confirmed is None else confirmed.scene
        self._candidates.serve(scene, verdict.to, verdict.rounds)
        self._changeover.begin(now, verdict, None if confirmed is None else confirmed.since_ns)

    # Steps that the states use.

    def _has_other(self) -> bool:
        """Tell whether another module could take over, or the failed one could return."""
        return any(key != self.active for key in self._candidates.of(self.scene))

    def _has_odometry(self, stamp_ns: int) -> bool:
        """Tell whether odometry came lately; a single message may be late."""
        if self._odom_ns is None:
            return False
        return stamp_ns - self._odom_ns <= BLIND * self._policy.lost_patience_s * 1e9

    def _look(self, observation: Observation) -> Situation:
        """Return all that is known at an observation."""
        hold, health = self._estimator.session.hold, self._estimator.session.health
        is_unled = hold.wheels_lie or not self._has_odometry(observation.stamp_ns)
        confirmed = self._watch.confirmed
        scene = self.scene if confirmed is None else confirmed.scene
        return Situation(
            stamp_ns=observation.stamp_ns,
            scene=scene,
            served_scene=self.scene,
            active=self.active,
            health=health,
            unheld_since_ns=hold.unheld_since_ns or 0,
            held_ns=hold.held_ns,
            is_blind=health is Health.LOST and is_unled,
            choices=self._candidates.of(scene),
            served_choices=self._candidates.of(self.scene),
            tried=self._candidates.tried,
            rounds=self._candidates.rounds,
            trial=self._changeover.trial,
            retry_ns=self._candidates.retry_ns,
            may_return=self._candidates.may_return,
            adrift_since_ns=hold.adrift_since_ns,
        )

    def _send(self, event: str, stamp_ns: int) -> None:
        """Send an event to the machine and log the state it leads to."""
        source = self.state
        self._machine.send(event)
        self.state = self._machine.state
        self._log.add("state", stamp_ns, **{"from": source, "to": self.state}, reason=event)

    def _spent_ns(self) -> int:
        """Return what all modules have cost so far."""
        return sum(runner.spent_ns for runner in self.runners.values())


def _wait(observation: Observation) -> Outcome | None:
    """Leave a state as it is until the next observation."""
    return None
