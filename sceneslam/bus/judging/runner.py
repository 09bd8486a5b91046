"""Run one SLAM module: call it, time it, and stop it when it violates its contract."""

from __future__ import annotations

import logging
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from time import perf_counter_ns

from sceneslam.answers import checked_layers, checked_tracking, checked_trajectory
from sceneslam.interfaces import Concurrent, Restartable, SlamModule
from sceneslam.types.errors import ModuleError, calling
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, Tracking
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)
_SKIPPED_MAX = 2000  # observations whose samples are kept, the newest: a minute at 30 per second


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Legacy:
    """The results of a module that was shut down."""

    layers: MapLayers
    trajectory: Trajectory  # T_local_base as revised, empty without revisions
    lost: str  # what it could not give, "" if it gave all


class Runner:
    """Turns every exception of a module into a ModuleError, and rejects invalid answers.

    Start and shutdown may take seconds: `executor` makes these calls, one after the other.
    """

    def __init__(self, key: str, module: SlamModule, executor: Executor) -> None:
        self.key = key
        self.is_failed = False
        self.is_awaited = False  # a call is under way that its caller waits for
        self._is_left = False
        self.T_map_local: Transform | None = None  # None until it is placed
        self.track_ms = array("d")
        self.spent_ns = 0  # total time that callers waited
        self.start_ns = 0  # time that the last start took
        self._executor = executor
        self._starting: Future[None] | None = None
        self._ending: Future[Legacy] | None = None
        self._is_active = False
        self._may_restart = True
        self._skipped = deque[Observation](maxlen=_SKIPPED_MAX)  # samples not given to it yet
        self._submitted: Observation | None = None  # observation whose answer was not collected yet
        self._module = module
        # Sensors in every set are needed; if the sets share none, any of their sensors will do.
        common = frozenset[Sensor].intersection(*module.requires)
        self.needs_wheels = False  # on this robot: its motion, or its scale, may be theirs
        self._sensors = common or frozenset[Sensor]().union(*module.requires)

    @property
    def can_run(self) -> bool:
        """Tell whether the module can be activated at once."""
        has_ended = self._ending is None or self._ending.done()
        return not self.is_failed or (
            has_ended and self._ask_restartable(lambda module: module.is_ready)
        )

    @property
    def may_return(self) -> bool:
        """Tell whether the module can be activated, at once or after a wait."""
        return not self.is_failed or self._ask_restartable(lambda module: not module.is_spent)

    @property
    def beside(self) -> str:
        """Return what the executor does for the module now: `starts`, `ends` or nothing."""
        for what, future in (("ends", self._ending), ("starts", self._starting)):
            if future is not None and not future.done():
                return what
        return ""

    def start(self, rig: Rig, scene: str) -> None:
        """Start the next activation of the module; `has_started` returns the result."""
        self.T_map_local, self.is_failed = None, False
        self._skipped.clear()
        usable = [sensors for sensors in self._module.requires if sensors <= rig.sensors]
        self.needs_wheels = bool(usable) and all(Sensor.ODOMETRY in sensors for sensors in usable)
        with self._timed():
            self._starting = self._executor.submit(self._activate, rig, scene)

    def has_started(self) -> bool:
        """Return whether the start is over; raises ModuleError if the module cannot start."""
        assert self._starting is not None, "started first"
        if not self._starting.done():
            return False
        self._starting.result()
        return True

    def place(self, T_map_local: Transform) -> None:
        """Set T_map_local (4, 4), which places the module's frame in the map."""
        self.T_map_local = T_map_local
        with self._timed(), self._asking("could not be placed"):
            self._module.set_pose(T_map_local.copy())

    def set_scene(self, scene: str) -> None:
        """Inform the running module of a newly confirmed scene."""
        with self._timed(), self._asking("could not take the scene"):
            self._module.set_scene(scene)

    def can_use(self, observation: Observation) -> bool:
        """Tell whether the observation holds data of any sensor that the module uses."""
        return any(observation.has(sensor) for sensor in self._sensors)

    def skip(self, observation: Observation) -> None:
        """Keep the gyro samples of an observation that the module is not given, for its next."""
        self._skipped.append(observation.samples())

    def submit(self, observation: Observation) -> None:
        """Submit an observation to a module in its own process; `track` collects the answer.

        Does nothing for any other module. Raises ModuleError as `track`.
        """
        if isinstance(self._module, Concurrent) and self.can_use(observation):
            with self._timed(), self._asking("failed while tracking"):
                self._submitted = self._joined(observation)
                self._module.submit(self._submitted)

    def track(self, observation: Observation) -> Tracking:
        """Return the module's answer; raises ModuleError on an exception or an invalid pose."""
        began_ns = perf_counter_ns()
        try:
            with self._timed(), self._asking("failed while tracking"):
                return checked_tracking(self._answer(observation), observation.stamp_ns)
        finally:
            self.track_ms.append((perf_counter_ns() - began_ns) / 1e6)

    def leave(self) -> None:
        """Ask nothing more of the module, which does not return from a call."""
        self._is_left = True

    def retire(self) -> Future[Legacy]:
        """Shut the module down; return its results, empty where it cannot give them."""
        with self._timed():
            self._ending = self._executor.submit(self._retire)
        return self._ending

    def close(self) -> None:
        """Wait until the module has shut down."""
        self._executor.shutdown()

    def _activate(self, rig: Rig, scene: str) -> None:
        began_ns = perf_counter_ns()
        with self._asking("could not be activated"):
            self._module.activate(rig)
            self._module.set_scene(scene)
            self._is_active = True
        self.start_ns = perf_counter_ns() - began_ns

    def _retire(self) -> Legacy:
        layers, trajectory, lost = MapLayers(), Trajectory.empty(), list[str]()
        if self._is_left:
            return Legacy(layers=layers, trajectory=trajectory, lost="")
        self._drain()
        if self._is_active:
            with self._parting("could not give its revised trajectory, which is lost", lost):
                trajectory = checked_trajectory(self._module.get_trajectory())
            with self._parting("could not give its map, which is lost", lost):
                layers = checked_layers(self._module.get_map())
        with self._parting("could not be shut down", []):
            self._module.shutdown()
        self._is_active = False
        return Legacy(layers=layers, trajectory=trajectory, lost="".join(lost[-1:]))

    def _answer(self, observation: Observation) -> Tracking:
        submitted, self._submitted = self._submitted, None
        if isinstance(self._module, Concurrent) and submitted is not None:
            answer = self._module.collect()
            if submitted.stamp_ns == observation.stamp_ns:
                return answer
        return self._module.track(self._joined(observation))

    def _joined(self, observation: Observation) -> Observation:
        """Return an observation with the samples of those that the module was not given."""
        skipped = list(self._skipped)
        self._skipped.clear()
        return observation.with_samples_of(*skipped)

    def _drain(self) -> None:
        """Discard a pending answer, so that the module can take another observation."""
        submitted, self._submitted = self._submitted, None
        if submitted is not None and isinstance(self._module, Concurrent):
            with suppress(Exception):  # a fault shows at the next call
                self._module.collect()

    @contextmanager
    def _asking(self, what: str) -> Iterator[None]:
        """Record a failure before it is raised again."""
        try:
            with calling(f"slam.{self.key} {what}"):
                yield
        except ModuleError:
            self.is_failed = True
            self._ask_restartable(lambda module: module.note_failure())
            raise

    def _ask_restartable(self, ask: Callable[[Restartable], object]) -> bool:
        """Return an answer of a failed module; one that raises is not started again."""
        try:
            with calling(f"slam.{self.key} could not tell whether it can be started again"):
                module = self._module
                return self._may_restart and isinstance(module, Restartable) and bool(ask(module))
        except ModuleError as error:
            _log.warning(str(error))
            self._may_restart = False
            return False

    @contextmanager
    def _parting(self, what: str, lost: list[str]) -> Iterator[None]:
        """Continue without a result that a module cannot give; add its description to `lost`."""
        try:
            with calling(f"slam.{self.key} {what}"):
                yield
        except ModuleError as error:
            _log.warning(str(error))
            lost.append(str(error))

    @contextmanager
    def _timed(self) -> Iterator[None]:
        """Add up the time that the caller waits, and tell that it does."""
        began_ns = perf_counter_ns()
        self.is_awaited = True
        try:
            yield
        finally:
            self.is_awaited = False
            self.spent_ns += perf_counter_ns() - began_ns
