"""The `process` SLAM module: a program in any language, connected by pipes."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from time import monotonic
from typing import Any, TypeVar

import numpy as np

from sceneslam.motion.late import Pipeline
from sceneslam.supervision.limits import Limits
from sceneslam.supervision.restarted import Restarted
from sceneslam.types.errors import ConfigError, ModuleError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, Tracking
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.run import Command
from sceneslam.types.trajectory import Trajectory

from ..local import LocalModule
from .fields import answers, layers, observation_fields, required, rig_fields, trajectory
from .program import Program
from .protocol import Fields, ProtocolError, text

Value = TypeVar("Value")
# The path is set after start-up: files in the user's folder must not shadow standard modules.
_MAIN = """
import json, sys
settings, *sys.path = sys.argv[1:]
from {module} import main
main(json.loads(settings))
"""


def python_command(module: str, settings: Mapping[str, object]) -> Command:
    """Return the command that calls `main(settings)` of a Python module, in another process."""
    main = _MAIN.format(module=module)
    return Command([sys.executable, "-P", "-c", main, json.dumps(settings), *sys.path])


class ProcessSlam(LocalModule, Restarted[Program]):
    """Implements `SlamModule`, `Restartable` and `Concurrent` by one run of a program per session.

    Any error of the program ends it, and the call raises ModuleError with one sentence. The next
    run is started at once, so that it is loaded before it is needed.
    """

    def __init__(
        self,
        *,
        command: Command,
        late_max_s: float,
        limits: Limits,
        closes_loops: bool,
    ) -> None:
        """Start the program; without `closes_loops` the atlas closes the loops of its poses."""
        if not command or shutil.which(command[0]) is None:
            raise ConfigError("command", command, "a program that can be run, and its arguments")
        if not 0 <= late_max_s < np.inf:
            raise ConfigError("late_max_s", late_max_s, "seconds, 0 or more")
        super().__init__(limits)
        self.closes_loops = closes_loops
        self._command, self._late_max_s = command, late_max_s
        self._requires: tuple[frozenset[Sensor], ...] | None = None
        self._pipeline = Pipeline(late_max_s)
        self._observation: Observation | None = None  # submitted, and not yet collected
        self._layers: MapLayers | None = None  # last returned map, None if outdated
        self._start()

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the sets of sensors that the program requires, by its first reply."""
        if self._requires is None:
            try:
                self._greet()
            except ModuleError as error:
                allowed = f"a program that answers a greeting ({error})"
                raise ConfigError("command", self._command, allowed) from error
        assert self._requires is not None
        return self._requires

    def note_failure(self) -> None:
        """Record that a session failed, and end its run of the program."""
        if self._running is not None:
            self._running.refuse("failed")
        self._close()
        super().note_failure()

    def activate(self, rig: Rig) -> None:
        """Start a session in a new run of the program."""
        self._bury()
        if self._is_active:
            self._close()
        self._restarts.await_start()
        if self._running is None:
            self._start()
        self._greet()
        self._pipeline = Pipeline(self._late_max_s, rig.wheels)
        self._layers = None
        self._is_active = True
        self._ask("activate", rig_fields(rig), self._limits.start_deadline_s, lambda _: None)

    def set_scene(self, scene: str) -> None:
        """Send the scene to the program."""
        fields = {"scene": text(scene)}
        self._ask("scene", fields, self._limits.step_deadline_s, lambda _: None)

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m] at the observation."""
        self.submit(observation)
        return self.collect()

    def submit(self, observation: Observation) -> None:
        """Send the observation without waiting; `collect` returns the result."""
        self._pipeline.note(observation)
        self._observation, self._layers = observation, None
        fields = observation_fields(observation)
        self._own_program(in_session=True).send("track", fields, self._limits.step_deadline_s)

    def collect(self) -> Tracking:
        """Return the result of `submit`."""
        observation, self._observation = self._observation, None
        assert observation is not None
        self._receive("track", self._limits.step_deadline_s, self._take)
        return self._pipeline.report(observation)

    def get_trajectory(self) -> Trajectory:
        """Return the program's revised poses, else those that came late, if any."""
        if not self._is_active:
            return self._pipeline.trajectory(Trajectory.empty())
        revised = self._ask("trajectory", {}, self._limits.start_deadline_s, trajectory)
        return self._pipeline.trajectory(revised)

    def get_map(self) -> MapLayers:
        """Return the program's map in `local`; the last one after `shutdown`."""
        if self._layers is None and self._is_active:
            self._layers = self._ask("map", {}, self._limits.start_deadline_s, layers)
        return self._layers or MapLayers()

    def shutdown(self) -> None:
        """Keep the map, end this run of the program, and start the next."""
        if not self._is_active:
            return
        try:
            if self._running is not None:
                self.get_map()
        finally:
            self._close()
        if self._restarts.wait_s(monotonic()) == 0:
            self._start()

    def _start(self) -> None:
        """Start the program and send the first request, without waiting."""
        self._is_greeted = self._is_active = False
        self._running = Program(self._command, self._limits)
        self._running.send("hello", {}, self._limits.start_deadline_s)

    def _greet(self) -> None:
        if not self._is_greeted:
            found = self._receive("hello", self._limits.start_deadline_s, required)
            if self._requires is not None and found != self._requires:
                raise self._own_program().refuse(
                    "requires other sensors than when it was started first"
                )
            self._requires, self._is_greeted = found, True

    def _bury(self) -> None:
        """Detect a program that ended while it was idle."""
        if self._running is not None and not self._running.is_alive:
            self.note_failure()

    def _close(self) -> None:
        if self._running is not None:
            self._running.end()
        self._running, self._is_active, self._is_greeted = None, False, False

    def _own_program(self, *, in_session: bool = False) -> Program:
        if self._running is None or (in_session and not self._is_active):
            raise ModuleError("the program ended, and the session with it")
        return self._running

    def _ask(
        self, kind: str, fields: Fields, deadline_s: float, read: Callable[[Fields], Value]
    ) -> Value:
        self._own_program(in_session=True).send(kind, fields, deadline_s)
        return self._receive(kind, deadline_s, read)

    def _receive(self, kind: str, deadline_s: float, read: Callable[[Fields], Value]) -> Value:
        """Return the decoded reply; an invalid reply ends the program."""
        reply = self._own_program().receive(kind, deadline_s)
        try:
            return read(reply)
        except (ProtocolError, ValueError, TypeError) as error:
            raise self._own_program().refuse(str(error)) from error

    def _take(self, reply: Fields) -> None:
        revision: Any = reply.get("revision", self._pipeline.revision)
        self._pipeline.take([replace(one, revision=int(revision)) for one in answers(reply)])
        self._pipeline.revision = int(revision)
