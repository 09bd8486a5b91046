"""The map during a run, built in a thread of its own, so that poses are not delayed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from time import monotonic

import numpy as np

from sceneslam.interfaces import LiveMapper
from sceneslam.types import se3
from sceneslam.types.errors import text_of
from sceneslam.types.maps import HybridMap, MovedMap, PointLayer
from sceneslam.types.observation import Observation
from sceneslam.types.rig import Rig
from sceneslam.types.se3 import Transform
from sceneslam.types.trail import Trail

_log = logging.getLogger(__name__)
_STEP_M, _STEP_RAD = 0.1, 0.1  # smallest motion between two observations in the map
_REST = 4.0  # times as long as a map takes: the run needs the processor
NOTHING = HybridMap(
    points=PointLayer(points=np.zeros((0, 3), np.float32)),
    point_modules=np.zeros(0, np.uint8),
    modules=(),
)


class LiveMap:
    """Adds observations from new poses to the map in a thread; only the newest one is queued."""

    def __init__(
        self, mapper: LiveMapper, *, every_s: float, publish: Callable[[HybridMap], None]
    ) -> None:
        self._mapper, self._every_s, self._publish = mapper, every_s, publish
        self._waiting: tuple[Observation, Transform, Transform] | None = None
        self._trail = Trail()
        self._T_map_drawn: Transform | None = None
        self._moved: list[MovedMap] = []  # that wait, oldest first
        self._newest = NOTHING
        self._is_closed = False
        self._error: Exception | None = None  # the first one
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def open(self, rig: Rig) -> None:
        """Start with an empty map."""
        self._mapper.open(rig)
        self._is_closed, self._newest, self._T_map_drawn = False, NOTHING, None
        self._trail, self._waiting, self._moved = Trail(), None, []
        self._thread = threading.Thread(target=self._draw, name="map", daemon=True)
        self._thread.start()

    def add(self, observation: Observation, T_map_base: Transform) -> None:
        """Queue an observation that can be drawn, if its pose T_map_base (4, 4) [m] is new."""
        self._trail.add(observation.stamp_ns, T_map_base)
        if not any(observation.has(sensor) for sensor in self._mapper.sensors):
            return
        if not self._is_new(T_map_base):
            return
        scan, T_map_then = observation.scan, T_map_base
        if scan is not None:
            T_map_then = T_map_base @ self._trail.base_at(scan.stamp_ns)
        with self._changed:
            self._waiting = (observation, T_map_base, T_map_then)
            self._changed.notify()

    def move(self, moved: MovedMap) -> None:
        """Queue a correction of what was drawn; the next observation is drawn in any case."""
        with self._changed:
            self._waiting, self._T_map_drawn = None, None
            self._moved.append(moved)
            self._changed.notify()

    def newest(self) -> HybridMap:
        """Return the latest map."""
        return self._newest

    def close(self) -> None:
        """Stop the thread; raises the first error of drawing, once. May be called twice."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _is_new(self, T_map_base: Transform) -> bool:
        if self._T_map_drawn is None:
            return True
        T_drawn_base = se3.inverse(self._T_map_drawn) @ T_map_base
        way_m = float(np.linalg.norm(T_drawn_base[:3, 3]))
        return way_m > _STEP_M or float(se3.rotation_angle_rad(T_drawn_base)) > _STEP_RAD

    def _draw(self) -> None:
        due_s, is_changed = monotonic(), False  # when the map may be published again
        while True:
            with self._changed:
                wait_s = due_s - monotonic() if is_changed else None
                self._changed.wait_for(
                    lambda: self._waiting or self._moved or self._is_closed, wait_s
                )
                waiting, self._waiting = self._waiting, None
                moved, self._moved = self._moved, []
            if self._is_closed:
                return
            try:
                for each in moved:
                    self._mapper.move(each)
                    is_changed = True
                if waiting is not None:
                    self._mapper.add(*waiting)
                    with self._changed:
                        self._T_map_drawn = None if self._moved else waiting[1]
                    is_changed = True
                if is_changed and monotonic() >= due_s:
                    began_s, is_changed = monotonic(), False
                    self._newest = self._mapper.map()
                    self._publish(self._newest)
                    due_s = monotonic() + max(self._every_s, _REST * (monotonic() - began_s))
            except Exception as error:  # the next observation may be drawn
                _log.debug("the live map", exc_info=error)
                if self._error is None:
                    _log.warning("the live map could not be drawn: %s", text_of(error))
                    self._error = error
