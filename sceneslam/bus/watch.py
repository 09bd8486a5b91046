"""Asks the detector about every observation, and says which scene is confirmed."""

from __future__ import annotations

import logging
from time import perf_counter_ns

from sceneslam.bus.events import EventLog
from sceneslam.bus.scene_filter import SceneFilter
from sceneslam.interfaces import Detector
from sceneslam.types.errors import ModuleError
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig

_log = logging.getLogger(__name__)


class Watch:
    """A detector under the bus's care: where it fails, the last scene stays."""

    def __init__(
        self, detector: Detector, rig: Rig, log: EventLog, *, window_s: float, first_window_s: float
    ) -> None:
        self.spent_us: list[float] = []
        self.is_working = True
        self._detector, self._log = detector, log
        self._filter = SceneFilter(window_s=window_s, first_window_s=first_window_s)
        try:
            detector.activate(rig)
        except Exception as error:
            what = f"detector could not be activated: {type(error).__name__}: {error}"
            raise ModuleError(what) from error

    @property
    def scene(self) -> str | None:
        """Return the confirmed scene, None before the first."""
        return self._filter.scene

    @property
    def since_ns(self) -> int:
        """Return the first image that said so."""
        return self._filter.since_ns

    def look(self, observation: Observation) -> None:
        """Take a vote and log it, and what it confirms."""
        began_ns = perf_counter_ns()
        try:
            vote = self._detector.get_scene(observation) if self.is_working else None
        except Exception as error:
            self.is_working, vote = False, None
            _log.warning("the detector failed: %s", error)
            self._log.add("fault", observation.stamp_ns, what=f"the detector failed: {error}")
        self.spent_us.append((perf_counter_ns() - began_ns) / 1e3)
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

    def close(self) -> None:
        """Shut the detector down. May be called twice."""
        self._detector.shutdown()
