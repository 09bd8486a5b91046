"""A SLAM module in a process of its own, with the interface of any module."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from time import monotonic
from typing import Any, cast

from sceneslam.interfaces import SlamModule
from sceneslam.supervision.limits import Limits
from sceneslam.supervision.process import Process, ProcessDeathError
from sceneslam.supervision.restarted import Restarted
from sceneslam.types.errors import ConfigError, ModuleError
from sceneslam.types.maps import MapLayers
from sceneslam.types.observation import Observation, Tracking
from sceneslam.types.rig import Rig, Sensor
from sceneslam.types.se3 import Transform
from sceneslam.types.trajectory import Trajectory

_log = logging.getLogger(__name__)
_DYING_S = 0.5  # if it dies within this time after a request, it was probably dead before


class IsolatedModule(Restarted[Process]):
    """Implements `SlamModule`, `Restartable` and `Concurrent`; `make` builds the module.

    The end of the process ends the session: the call raises ModuleError with the reason, a new
    process is started as soon as `Limits` allow, and `activate` starts a session in it. Exceptions
    of the module itself are raised here unchanged. A caller that stops a failed session must call
    `note_failure`.
    """

    def __init__(self, name: str, make: Callable[[], SlamModule], limits: Limits) -> None:
        """Start the process; reading `requires` waits until the module is built."""
        if not hasattr(os, "memfd_create"):
            raise ConfigError("isolation", "process", "inline (processes need Linux)")
        super().__init__(limits)
        self._name, self._make = name, make
        self._requires: tuple[frozenset[Sensor], ...] | None = None
        self._closes_loops = False
        self._start()

    @property
    def requires(self) -> tuple[frozenset[Sensor], ...]:
        """Return the module's requirements; raises the exception of its constructor, if any."""
        if self._requires is None:
            self._await_built()
        assert self._requires is not None
        return self._requires

    @property
    def closes_loops(self) -> bool:
        """Tell whether the module closes loops itself."""
        if self._requires is None:
            self._await_built()
        return self._closes_loops

    def activate(self, rig: Rig) -> None:
        """Start a session, in a new process if the last one died; may wait for a restart."""
        self._bury()
        was_idle, asked_s = self._running is not None and self._is_greeted, monotonic()
        try:
            self._begin(rig)
        except ProcessDeathError:
            # A process with threads may still seem alive after it was killed while idle.
            if not was_idle or monotonic() - asked_s > _DYING_S:
                raise
            self.note_failure()
            self._begin(rig)

    def set_pose(self, T_map_local: Transform) -> None:
        """Set T_map_local (4, 4) [m]."""
        self._call(self._limits.step_deadline_s, "set_pose", T_map_local)

    def set_scene(self, scene: str) -> None:
        """Set the confirmed scene."""
        self._call(self._limits.step_deadline_s, "set_scene", scene)

    def track(self, observation: Observation) -> Tracking:
        """Return T_local_base (4, 4) [m] at the observation."""
        self.submit(observation)
        return self.collect()

    def submit(self, observation: Observation) -> None:
        """Start tracking without waiting; `collect` returns the result."""
        self._ask("track", observation)

    def collect(self) -> Tracking:
        """Return the result of `submit`."""
        return cast(Tracking, self._answer(self._limits.step_deadline_s))

    def get_trajectory(self) -> Trajectory:
        """Return T_local_base (4, 4) [m] at every stamp."""
        return cast(Trajectory, self._call(self._limits.start_deadline_s, "get_trajectory"))

    def get_map(self) -> MapLayers:
        """Return the map in `local`."""
        return cast(MapLayers, self._call(self._limits.start_deadline_s, "get_map"))

    def shutdown(self) -> None:
        """Shut the module down; its process keeps the map until the next `activate`."""
        if self._is_active:
            self._call(self._limits.start_deadline_s, "shutdown")

    def close(self) -> None:
        """End the process. May be called twice."""
        if self._running is not None:
            self._running.end()
        self._running, self._is_active = None, False

    def _begin(self, rig: Rig) -> None:
        self._restarts.await_start()
        if self._running is None:
            self._start()
        self._await_built()
        self._is_active = True
        self._call(self._limits.start_deadline_s, "activate", rig)

    def _start(self) -> None:
        """Start a process that builds the module, without waiting."""
        self._is_greeted = self._is_active = False
        self._running = Process(self._limits)
        level = logging.getLogger().getEffectiveLevel()
        self._running.submit("build", self._make, level, self._limits.memory_limit_mb)

    def _await_built(self) -> None:
        if not self._is_greeted:
            built = self._answer(self._limits.start_deadline_s)
            self._requires, self._closes_loops = built
            self._is_greeted = True

    def _call(self, deadline_s: float, method: str, *arguments: object) -> Any:
        self._ask(method, *arguments)
        return self._answer(deadline_s)

    def _ask(self, method: str, *arguments: object) -> None:
        if self._running is None or not self._is_active:
            raise ModuleError(f"{method}: its process ended, and the session with it")
        try:
            self._running.submit(method, *arguments)
        except ProcessDeathError:
            self._replace()
            raise

    def _answer(self, deadline_s: float) -> Any:
        if self._running is None:
            raise ModuleError("its process ended")
        try:
            return self._running.collect(deadline_s)
        except ProcessDeathError:
            self._replace()
            raise

    def _bury(self) -> None:
        """Detect a process that died while it was idle."""
        if self._running is not None and not self._running.is_alive:
            _log.warning("%s: its process died while it was idle", self._name)
            self._running.end()
            self.note_failure()
            self._replace()

    def _replace(self) -> None:
        """Start the next process if a restart is allowed; it builds the module in parallel."""
        self._running, self._is_active, self._is_greeted = None, False, False
        if self._restarts.wait_s(monotonic()) == 0 and self._requires is not None:
            self._start()
