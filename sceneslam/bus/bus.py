"""The bus: asks the detector, drives the state machine, and runs the module the scene calls for."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from enum import Enum
from time import perf_counter_ns

from sceneslam.atlas.atlas import Atlas
from sceneslam.bus.candidates import Candidates
from sceneslam.bus.estimator import Estimator
from sceneslam.bus.events import EventLog
from sceneslam.bus.machine import BusMachine
from sceneslam.bus.policy import Policy, SceneFilter
from sceneslam.bus.runner import Runner
from sceneslam.interfaces import Detector, SlamModule
from sceneslam.types.errors import ModuleError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig

_log = logging.getLogger(__name__)


class Outcome(Enum):
    """What a state reports to the machine: the S and F of the paper."""

    SUCCESS = "success"
    FAILURE = "failure"


class Bus:
    """Feeds observations to the detector and the active module, one `step` at a time.

    `scenes` maps every scene to keys of `modules`: the one to run, then its fallbacks.
    """

    def __init__(
        self,
        *,
        detector: Detector,
        modules: Mapping[str, SlamModule],
        scenes: Mapping[str, Sequence[str]],
        policy: Policy,
        rig: Rig,
        atlas: Atlas,
        log: EventLog,
    ) -> None:
        self.runners = {key: Runner(key, module) for key, module in modules.items()}
        self.detector_us: list[float] = []
        self.bus_us: list[float] = []
        self._detector, self._policy, self._log = detector, policy, log
        self._filter = SceneFilter(
            window_s=policy.confirm_window_s, first_window_s=policy.first_confirm_window_s
        )
        self._estimator = Estimator(policy=policy, rig=rig, atlas=atlas, log=log)
        self._machine = BusMachine(self)
        self._state = self._machine.state
        self._candidates = Candidates(scenes, self.runners, policy.confirm_window_s)
        self._reason = "first"  # why a module is chosen: first, scene, lost, failed
        self._detector_works = True
        try:
            detector.activate(rig)
        except Exception as error:
            what = f"detector could not be activated: {type(error).__name__}: {error}"
            raise ModuleError(what) from error

    @property
    def state(self) -> str:
        """Return the state that the machine is in."""
        return self._state

    @property
    def active(self) -> str:
        """Return the key of the active module, "" when there is none."""
        return self._estimator.active.key if self._estimator.active else ""

    @property
    def scene(self) -> str:
        """Return the confirmed scene, "" before the first."""
        return self._candidates.scene

    def step(self, observation: Observation) -> None:
        """Take one observation: vote, track, and change state where that is called for."""
        began_ns = perf_counter_ns()
        spent_ns = self._spent_ns()
        self._vote(observation)
        outcome = self._init() if self._state == "init" else self._run(observation)
        while outcome is not None:
            self._send(outcome.value, observation.stamp_ns)
            outcome = self._enter(observation)
        own_ns = perf_counter_ns() - began_ns - (self._spent_ns() - spent_ns)
        self.bus_us.append(own_ns / 1e3 - self.detector_us[-1])

    def close(self, stamp_ns: int) -> None:
        """End the run: shut the module down, then the detector. May be called twice."""
        if self._state != "terminate":
            self._send("stop", stamp_ns)
        self._estimator.retire()
        self._detector.shutdown()

    # What the machine asks before it takes a failure's way out.

    def candidate_left(self) -> bool:
        """Tell whether the scene has a module that was not tried yet."""
        return bool(self._candidates.left())

    def fallback_active(self) -> bool:
        """Tell whether a module runs, though not the first choice."""
        return self._estimator.active is not None

    # The states.

    def _init(self) -> Outcome | None:
        """Wait for the first confirmed scene."""
        if not self._detector_works:
            return Outcome.FAILURE
        if self._filter.scene is None:
            return None
        self._candidates.begin(self._filter.scene)
        return Outcome.SUCCESS

    def _enter(self, observation: Observation) -> Outcome | None:
        """Do what the state just entered does with the observation it was entered at."""
        if self._state == "start":
            return self._start(observation)
        if self._state == "switch":
            return self._switch(observation)
        return None

    def _start(self, observation: Observation) -> Outcome:
        """Activate the next candidate."""
        is_launched = self._launch(self._candidates.left()[0], observation)
        return Outcome.SUCCESS if is_launched else Outcome.FAILURE

    def _run(self, observation: Observation) -> Outcome | None:
        """Track; fail when the scene calls for another module or the active one is unhealthy."""
        self._track(observation)
        reason = self._reason_to_switch(observation)
        if reason is None:
            return None
        self._reason = reason
        return Outcome.FAILURE

    def _switch(self, observation: Observation) -> Outcome:
        """Hand over to the first choice, else to the first fallback that can be activated."""
        outcome = Outcome.SUCCESS
        for key in self._candidates.left():
            if key == self.active or self._launch(key, observation):
                return outcome
            outcome = Outcome.FAILURE
        active = self._estimator.active
        if active is not None and active.is_failed:
            self._estimator.retire()
        return Outcome.FAILURE

    # What they are made of.

    def _vote(self, observation: Observation) -> None:
        """Ask the detector; log a scene that its vote confirms."""
        began_ns = perf_counter_ns()
        try:
            vote = self._detector.get_scene(observation) if self._detector_works else None
        except Exception as error:
            self._detector_works, vote = False, None
            self._fault(observation.stamp_ns, f"the detector failed: {error}")
        self.detector_us.append((perf_counter_ns() - began_ns) / 1e3)
        if vote is None:
            return
        self._log.add("vote", vote.stamp_ns, scene=vote.scene, value=vote.value)
        confirmed = self._filter.update(vote)
        if confirmed is not None:
            self._log.add(
                "scene",
                confirmed.stamp_ns,
                scene=confirmed.scene,
                previous=confirmed.previous,
                since_ns=confirmed.since_ns,
            )

    def _track(self, observation: Observation) -> None:
        try:
            self._estimator.track(observation, by_velocity=self.candidate_left())
        except ModuleError as error:
            self._fault(observation.stamp_ns, str(error))
            self._estimator.bridge(observation, by_velocity=True)

    def _reason_to_switch(self, observation: Observation) -> str | None:
        """Return why another module has to take over, None when the active one goes on."""
        active = self._estimator.active
        assert active is not None
        if self._filter.scene is not None and self._filter.scene != self.scene:
            self._candidates.begin(self._filter.scene)
            if self._candidates.left()[:1] != [active.key]:
                return "scene"
            self._candidates.use(active.key)
            self._tell_scene(active, observation.stamp_ns)
        if active.is_failed:
            return "failed"
        return "lost" if self._is_out_of_patience(observation) and self.candidate_left() else None

    def _tell_scene(self, active: Runner, stamp_ns: int) -> None:
        try:
            active.set_scene(self.scene)
        except ModuleError as error:
            self._fault(stamp_ns, str(error))

    def _is_out_of_patience(self, observation: Observation) -> bool:
        """Tell whether the active module has been lost for too long."""
        lost_since_ns = self._estimator.lost_since_ns
        if lost_since_ns is None:
            return False
        lost_ns = observation.stamp_ns - lost_since_ns
        self._candidates.reconsider(self.active, held_ns=self._estimator.held_ns, lost_ns=lost_ns)
        is_blind = self._estimator.is_lost and observation.T_odom_base is None
        policy = self._policy
        patience_s = policy.blind_patience_s if is_blind else policy.lost_patience_s
        return lost_ns >= round(patience_s * 1e9)

    def _launch(self, key: str, observation: Observation) -> bool:
        """Hand over to a module; log the decision, or that the module refused."""
        previous = self.active or None
        self._candidates.use(key)
        is_launched = self._estimator.launch(self.runners[key], observation, self.scene)
        self._log.add(
            "decision" if is_launched else "refused",
            observation.stamp_ns,
            scene=self.scene,
            **{"from": previous, "to": key},
            reason=self._reason,
        )
        return is_launched

    def _send(self, event: str, stamp_ns: int) -> None:
        """Send an event to the machine and log the state it leads to."""
        source = self._state
        self._machine.send(event)
        self._state = self._machine.state
        self._log.add("state", stamp_ns, **{"from": source, "to": self._state}, reason=event)

    def _fault(self, stamp_ns: int, what: str) -> None:
        _log.warning(what)
        self._log.add("fault", stamp_ns, what=what)

    def _spent_ns(self) -> int:
        """Return what all modules have cost so far."""
        return sum(runner.spent_ns for runner in self.runners.values())
